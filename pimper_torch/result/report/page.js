// Draws a run's report: its surface under a light that moves, its photographs, its tables.
// Text from files is only ever written as text, and nothing is fetched.
"use strict";
(() => {
  const began = performance.now();
  const find = (id) => document.getElementById(id);
  const data = JSON.parse(find("data").textContent);
  const make = (tag, attributes = {}, ...children) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "text") element.textContent = value;
      else if (name === "on") element.addEventListener("click", value);
      else element.setAttribute(name, value);
    }
    element.append(...children);
    return element;
  };
  const vector = (values) => new THREE.Vector3(...values);

  find("title").textContent = data.title;
  find("headline").textContent = data.headline;

  // ---- Photographs -------------------------------------------------------------------------

  const picture = (source, view, outlined) => {
    const box = make("div", { class: view.reliable ? "picture" : "picture doubted" });
    box.append(make("img", { src: source, alt: view.name, loading: "lazy" }));
    if (outlined && view.outline) {
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
      svg.setAttribute("viewBox", `0 0 ${view.width} ${view.height}`);
      svg.setAttribute("preserveAspectRatio", "none");
      path.setAttribute("d", view.outline);
      svg.append(path);
      box.append(svg);
    }
    return box;
  };
  // Leave of a box what is inside the silhouette.
  const clip = (box, view) => {
    if (!view.outline) return;
    const path = find("inside").firstElementChild;
    path.setAttribute("d", view.outline);
    path.setAttribute("transform", `scale(${1 / view.width} ${1 / view.height})`);
    box.style.clipPath = "url(#inside)";
  };
  const thumbnails = data.views.map((view, index) => {
    const title = view.figure ? `${view.name}: ${view.figure}` : view.name;
    const button = make("button", { type: "button", title, "aria-pressed": "false",
      on: () => select(index) });
    button.append(picture(view.photo, view, true), make("span", { text: view.name }));
    find("thumbnails").append(button);
    return button;
  });

  const HINT = find("hint").textContent;
  let selected = -1;
  const select = (index) => {
    selected = selected === index ? -1 : index;
    thumbnails.forEach((button, at) => button.setAttribute("aria-pressed", String(at === selected)));
    const view = data.views[selected];
    find("pair").hidden = find("fade").hidden = !view;
    find("hint").textContent = view ? thumbnails[selected].title : HINT;
    if (view) {
      find("photo").replaceChildren(picture(view.photo, view, true));
      find("predicted").hidden = find("different").hidden = !view.prediction;
      if (view.prediction) {
        find("prediction").replaceChildren(picture(view.prediction, view, false));
        const both = picture(view.photo, view, false);
        both.append(make("img", { src: view.prediction, alt: "" }));
        find("difference").replaceChildren(both);
        clip(both, view);
      }
      thumbnails[selected].scrollIntoView({ block: "nearest", inline: "nearest" });
    }
    scene?.stand(view);
  };

  // ---- Tables ------------------------------------------------------------------------------

  const cell = (value, column) => {
    if (column.kind === "bar") {
      const bar = make("i");
      bar.style.width = `${100 * value}%`;
      return make("td", { class: "bar" }, bar);
    }
    return make("td", { class: column.kind, text: value });
  };
  const table = ({ columns, rows }) => {
    const head = make("tr", {}, ...columns.map((one) => make("th", { class: one.kind, text: one.title })));
    const body = rows.map((row) => make("tr", {}, ...row.map((value, at) => cell(value, columns[at]))));
    return make("div", { class: "scroll" }, make("table", {}, make("thead", {}, head), make("tbody", {}, ...body)));
  };
  for (const section of data.sections) {
    const parts = [];
    if (section.text) parts.push(make("p", { class: "faint", text: section.text }));
    if (section.items) parts.push(make("ul", {}, ...section.items.map((text) => make("li", { text }))));
    if (section.table) parts.push(table(section.table));
    if (section.code) parts.push(make("pre", { text: section.code }));
    find("sections").append(section.folded
      ? make("details", {}, make("summary", { text: section.title }), ...parts)
      : make("section", {}, make("h2", { text: section.title }), ...parts));
  }

  // ---- The surface -------------------------------------------------------------------------

  const VIRIDIS = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"];
  const [NEAR, FAR, FOV_DEG] = [0.01, 100, 30]; // planes in units of the scene's radius
  const REMOTE = 1e-3; // the surface's radius over the distance of a light that is far
  const OPENGL = new THREE.Matrix4().makeScale(1, -1, -1); // from x right, y down, z forward

  class Surface {
    constructor(object) {
      this.stage = find("stage");
      this.canvas = find("canvas");
      this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
      this.camera = new THREE.PerspectiveCamera(FOV_DEG, 1, 1, 10);
      this.world = new THREE.Scene();
      this.object = object;
      const { scene_from_asset: back } = object.userData; // cameras are in the frame of the scene
      if (back) object.geometry.applyMatrix4(new THREE.Matrix4().fromArray(back));
      object.geometry.computeBoundingSphere();
      ({ center: this.center, radius: this.radius } = object.geometry.boundingSphere);
      object.geometry.computeBoundingBox();
      const box = object.geometry.boundingBox; // the lights' distances are in its half diagonals
      this.middle = { center: box.getCenter(new THREE.Vector3()), radius: box.min.distanceTo(box.max) / 2 };
      this.up = vector(data.up);
      this.light = new THREE.PointLight();
      this.ambient = new THREE.AmbientLight();
      this.markers = new THREE.Group();
      this.lamps = new THREE.Group();
      this.markers.visible = this.lamps.visible = false;
      this.world.add(object, this.light, this.ambient, this.markers, this.lamps);
      this.lamp = { view: new THREE.Vector3(-0.45, 0.55, 0.7).normalize(), fitted: null };
      this.behind = null; // the photograph whose camera is stood behind
      this.layers = this.makeLayers();
      this.makeMarkers();
      this.controls = new THREE.OrbitControls(this.camera, this.canvas);
      this.controls.addEventListener("start", () => this.leave());
      this.controls.addEventListener("change", () => this.draw());
      this.listen();
      this.home();
      new ResizeObserver(() => this.resize()).observe(this.stage);
    }

    makeLayers() {
      const { material, geometry } = this.object;
      const { map, normalMap } = material;
      const side = 2; // both
      material.side = side;
      const grey = new THREE.MeshPhysicalMaterial({ color: 0xb8b8b8, roughness: 1, normalMap, side });
      grey.specularIntensity = 0;
      const layers = [
        { title: "lit", material },
        { title: "shape", material: grey },
        { title: "albedo", material: new THREE.MeshBasicMaterial({ map, side }), unlit: true },
        { title: "normals", material: new THREE.MeshNormalMaterial({ normalMap, side }), unlit: true },
      ];
      for (const layer of data.layers) {
        const values = geometry.attributes[layer.attribute];
        if (values) layers.push({ ...layer, values, unlit: true,
          material: new THREE.MeshBasicMaterial({ vertexColors: true, side }) });
      }
      layers.forEach((layer) => {
        layer.normalMap = layer.material.normalMap;
        layer.button = make("button", { type: "button", "aria-pressed": "false", text: layer.title,
          on: () => this.show(layer) });
        if (layer.about) layer.button.title = layer.about;
        find("layers").append(layer.button);
      });
      this.shown = layers[0];
      return layers;
    }

    show(layer) {
      this.shown = layer;
      for (const one of this.layers) one.button.setAttribute("aria-pressed", String(one === layer));
      if (layer.values) this.paint(layer);
      const material = layer.material;
      if ("normalMap" in material) {
        const wanted = find("detail").checked ? layer.normalMap : null;
        if (material.normalMap !== wanted) {
          material.normalMap = wanted;
          material.needsUpdate = true;
        }
      }
      this.object.material = material;
      find("legend").hidden = !layer.values;
      find("lamp").style.display = layer.unlit ? "none" : "";
      this.draw();
    }

    paint(layer) {
      const { values, low, high } = layer;
      const stops = VIRIDIS.map((one) => new THREE.Color(one));
      const colors = new Float32Array(3 * values.count);
      const color = new THREE.Color();
      for (let at = 0; at < values.count; at++) {
        const share = Math.min(Math.max((values.getX(at) - low) / (high - low || 1), 0), 1);
        const place = share * (stops.length - 1);
        const stop = Math.min(Math.floor(place), stops.length - 2);
        color.lerpColors(stops[stop], stops[stop + 1], place - stop).toArray(colors, 3 * at);
      }
      this.object.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colors, 3));
      find("low").textContent = layer.low_text;
      find("high").textContent = layer.high_text;
      find("legend").querySelector("i").style.background = `linear-gradient(90deg, ${VIRIDIS})`;
    }

    makeMarkers() {
      const lines = [];
      this.bulbs = [];
      for (const view of data.views) {
        view.worldFromCamera = new THREE.Matrix4().set(...view.pose).invert();
        view.place = new THREE.Vector3().applyMatrix4(view.worldFromCamera);
        const size = 0.08 * view.place.distanceTo(this.center);
        const [fx, fy] = view.focal, [cx, cy] = view.centre;
        const corners = [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]].map(
          ([x, y]) => new THREE.Vector3((x - cx) / fx, (y - cy) / fy, 1).multiplyScalar(size)
            .applyMatrix4(view.worldFromCamera));
        corners.forEach((corner, at) => lines.push(view.place, corner, corner, corners[(at + 1) % 4]));
        if (view.light) {
          view.bulb = vector(view.light.direction).multiplyScalar(1.8 * this.radius).add(this.center);
          this.bulbs.push(view.bulb);
        }
      }
      const of = (points) => new THREE.BufferGeometry().setFromPoints(points);
      this.markers.add(new THREE.LineSegments(of(lines), new THREE.LineBasicMaterial({ color: 0x8fd3ff })));
      this.lamps.add(new THREE.Points(of(this.bulbs), new THREE.PointsMaterial({ color: 0xffd24a, size: 6,
        sizeAttenuation: false })));
      this.ray = new THREE.LineSegments(of([this.center, this.center]),
        new THREE.LineBasicMaterial({ color: 0xffd24a }));
      this.lamps.add(this.ray);
    }

    listen() {
      for (const [box, group] of [["cameras", this.markers], ["lights", this.lamps]]) {
        find(box).addEventListener("change", (event) => {
          group.visible = event.target.checked;
          this.home();
        });
      }
      find("detail").addEventListener("change", () => this.show(this.shown));
      find("ambient").addEventListener("input", () => { this.lamp.fitted = null; this.draw(); });
      find("home").addEventListener("click", () => { if (selected >= 0) select(selected); this.home(); });
      find("opacity").addEventListener("input", () => this.fade());
      const lamp = find("lamp");
      const point = (event) => {
        const box = lamp.getBoundingClientRect();
        this.aim((2.3 * (event.clientX - box.left)) / box.width - 1.15,
          1.15 - (2.3 * (event.clientY - box.top)) / box.height);
      };
      lamp.addEventListener("pointerdown", (event) => { lamp.setPointerCapture(event.pointerId); point(event); });
      lamp.addEventListener("pointermove", (event) => { if (event.buttons) point(event); });
      lamp.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
        if (!step) return;
        event.preventDefault();
        const { x, y } = this.direction();
        this.aim(x + step[0], y + step[1]);
      });
      let down = null;
      this.canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
      this.canvas.addEventListener("pointerup", (event) => {
        if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 5) this.pick(event);
      });
    }

    // Let the light come from a point of the hemisphere before the viewer.
    aim(x, y) {
      const length = Math.hypot(x, y);
      const shrink = Math.min(1, 0.999 / (length || 1));
      [x, y] = [x * shrink, y * shrink];
      this.lamp = { view: new THREE.Vector3(x, y, Math.sqrt(1 - x * x - y * y)), fitted: null };
      this.draw();
    }

    direction() {
      if (!this.lamp.fitted) return this.lamp.view;
      return vector(this.lamp.fitted.direction).transformDirection(this.camera.matrixWorldInverse);
    }

    pick(event) {
      if (!this.markers.visible) return;
      const box = this.canvas.getBoundingClientRect();
      let [best, nearest] = [-1, 18];
      data.views.forEach((view, index) => {
        const seen = view.place.clone().project(this.camera);
        const away = Math.hypot((seen.x + 1) * box.width / 2 - (event.clientX - box.left),
          (1 - seen.y) * box.height / 2 - (event.clientY - box.top));
        if (seen.z < 1 && away < nearest) [best, nearest] = [index, away];
      });
      if (best >= 0 && best !== selected) select(best);
    }

    home() {
      const reference = data.views[data.reference];
      const towards = reference.place.clone().sub(this.center).normalize();
      const shown = [...(this.markers.visible ? data.views.map((view) => view.place) : []),
        ...(this.lamps.visible ? this.bulbs : [])];
      const farthest = Math.max(this.radius, ...shown.map((place) => place.distanceTo(this.center)));
      this.reach = 1.08 * farthest / Math.sin((FOV_DEG * Math.PI) / 360);
      this.camera.up.copy(this.up);
      this.camera.position.copy(this.center).addScaledVector(towards, this.reach);
      this.controls.target.copy(this.center);
      this.leave(true);
      this.controls.update();
    }

    // Stand behind the camera of a photograph, under its light; or leave it.
    stand(view) {
      if (!view) {
        this.lamp.fitted = null;
        return this.leave(true);
      }
      this.behind = view;
      this.camera.matrixWorld.multiplyMatrices(view.worldFromCamera, OPENGL);
      this.camera.matrixWorld.decompose(this.camera.position, this.camera.quaternion, this.camera.scale);
      const depth = this.center.clone().applyMatrix4(new THREE.Matrix4().set(...view.pose)).z;
      this.controls.target.set(0, 0, -depth).applyMatrix4(this.camera.matrixWorld);
      if (view.light) {
        this.lamp = { ...this.lamp, fitted: view.light };
        this.ray.geometry.setFromPoints([this.center, view.bulb]);
      }
      find("overlay").src = view.photo;
      this.resize();
    }

    leave(redraw) {
      const was = this.behind;
      this.behind = null;
      find("overlay").hidden = true;
      find("fade").hidden = true;
      if (was || redraw) this.resize();
    }

    fade() {
      const share = Number(find("opacity").value);
      find("overlay").style.opacity = share;
      find("overlay").hidden = !this.behind || share === 0;
    }

    resize() {
      const [width, height] = [this.stage.clientWidth, this.stage.clientHeight];
      this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
      this.renderer.setSize(width, height, false);
      const [near, far] = [NEAR * this.radius, FAR * this.radius];
      Object.assign(this.camera, { aspect: width / height, near, far });
      // Narrow pictures see as much across as square ones see upward.
      const half = Math.tan((FOV_DEG * Math.PI) / 360) / Math.min(1, width / height);
      this.camera.fov = (360 / Math.PI) * Math.atan(half);
      this.camera.updateProjectionMatrix();
      if (this.behind) this.frame(width, height, near, far);
      this.fade();
      this.draw();
    }

    // The photograph's own pinhole, as large as it fits into the canvas.
    frame(width, height, near, far) {
      const { focal: [fx, fy], centre: [cx, cy], ...view } = this.behind;
      const scale = Math.min(width / view.width, height / view.height);
      const [left, top] = [(width - scale * view.width) / 2, (height - scale * view.height) / 2];
      this.camera.projectionMatrix.set(
        2 * scale * fx / width, 0, 1 - 2 * (left + scale * cx) / width, 0,
        0, 2 * scale * fy / height, 2 * (top + scale * cy) / height - 1, 0,
        0, 0, -(far + near) / (far - near), -2 * far * near / (far - near),
        0, 0, -1, 0);
      this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
      Object.assign(find("overlay").style, { left: `${left}px`, top: `${top}px`,
        width: `${scale * view.width}px`, height: `${scale * view.height}px` });
    }

    draw() {
      if (this.pending) return;
      this.pending = true;
      requestAnimationFrame(() => {
        this.pending = false;
        this.drawNow();
      });
    }

    drawNow() {
      this.camera.updateMatrixWorld();
      const towards = this.direction();
      const { fitted } = this.lamp;
      const distance = this.middle.radius / Math.max(fitted?.closeness ?? 0, REMOTE);
      this.light.position.copy(towards).transformDirection(this.camera.matrixWorld)
        .multiplyScalar(distance).add(this.middle.center);
      // Radiance is albedo times light here; the renderer divides it by pi, and by the distance's
      // square.
      this.light.intensity = Math.PI * distance ** 2;
      if (fitted) {
        this.light.color.setRGB(...fitted.directed);
        this.ambient.color.setRGB(...fitted.ambient);
        this.ambient.intensity = Math.PI;
      } else {
        const ambient = Number(find("ambient").value);
        this.light.color.set(0xffffff);
        this.ambient.color.set(0xffffff);
        this.ambient.intensity = Math.PI * ambient;
      }
      const bulb = find("lamp").querySelector(".bulb");
      bulb.setAttribute("cx", towards.x);
      bulb.setAttribute("cy", -towards.y);
      bulb.style.opacity = towards.z < 0 ? 0.35 : 1;
      this.renderer.render(this.world, this.camera);
      const { dataset } = document.documentElement;
      dataset.frames = Number(dataset.frames || 0) + 1;
      dataset.ready ??= String(Math.round(performance.now() - began));
    }
  }

  // ---- Start -------------------------------------------------------------------------------

  let scene = null;
  const fail = (error) => {
    find("trouble").textContent = `The surface cannot be drawn here: ${error.message || error}. The photographs and tables below need no WebGL.`;
    find("trouble").hidden = false;
    find("tools").hidden = true;
  };
  const bytes = Uint8Array.from(atob(find("asset").textContent.trim()), (one) => one.charCodeAt(0));
  find("download").href = URL.createObjectURL(new Blob([bytes], { type: "model/gltf-binary" }));
  new THREE.GLTFLoader().parse(bytes.buffer, "", ({ scene: loaded }) => {
    let object = null;
    loaded.traverse((one) => { object ??= one.isMesh ? one : null; });
    try {
      scene = new Surface(object);
      scene.show(scene.shown);
      if (selected >= 0) scene.stand(data.views[selected]);
    } catch (error) { fail(error); }
  }, fail);
})();
