// Draws a run's report: its surface under a movable light, its photographs, its tables.
// Text from files is inserted only as text, never as HTML, and nothing is fetched.
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

  // Text between backticks is code.
  const prose = (text) => text.split(/`([^`]+)`/).map((part, at) => at % 2 ? make("code", { text: part }) : part);
  const thousands = (number) => number.toLocaleString("en");
  const digits = (number, count) => String(Number(number.toPrecision(count)));

  const { summary } = data;
  const simpler = summary.simplified || summary.reduced;
  find("title").textContent = data.title;
  find("headline").textContent = [
    `${summary.registered} of ${summary.views} photographs${summary.diagnosis ? " (cameras unreliable)" : ""}`,
    `${thousands(summary.triangles)} facets`,
    `${thousands((simpler || summary).vertices)} vertices`
      + (simpler ? ` in mesh.ply (${thousands(summary.vertices)} before simplification)` : ""),
    `${summary.seconds.toFixed(0)} s`,
  ].join(", ");

  // ---- Photographs -------------------------------------------------------------------------

  const picture = (source, view, outlined) => {
    const box = make("div", { class: view.reliable ? "picture" : "picture unreliable" });
    box.style.setProperty("--shape", view.width / view.height);
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
  // Clip a box to the silhouette.
  const clip = (box, view) => {
    if (!view.outline) return;
    const path = find("inside").firstElementChild;
    path.setAttribute("d", view.outline);
    path.setAttribute("transform", `scale(${1 / view.width} ${1 / view.height})`);
    box.style.clipPath = "url(#inside)";
  };
  const thumbnails = data.views.map((view, index) => {
    const title = "psnr_db" in view ? `${view.name}: ${view.psnr_db.toFixed(1)} dB` : view.name;
    const button = make("button", { type: "button", title, "aria-pressed": "false",
      on: () => select(index) });
    button.append(picture(view.photo, view, true), make("span", { text: view.name }));
    find("thumbnails").append(button);
    return button;
  });
  // Explain a PSNR: as an error of 8-bit values, and by its rank among the photographs.
  const worth = (view) => {
    if (!("psnr_db" in view)) return "";
    const all = data.views.filter((other) => "psnr_db" in other);
    const rank = 1 + all.filter((other) => other.psnr_db > view.psnr_db).length;
    const error = 255 * 10 ** (-view.psnr_db / 20);
    return `${view.psnr_db.toFixed(1)} dB (PSNR): the prediction is off by ${digits(error, 2)} of 255 `
      + `(root mean square). Higher is better; this is number ${rank} of ${all.length}.`;
  };

  const HINT = [...find("hint").childNodes];
  let selected = -1;
  const select = (index) => {
    selected = selected === index ? -1 : index;
    thumbnails.forEach((button, at) => button.setAttribute("aria-pressed", String(at === selected)));
    const view = data.views[selected];
    find("compared").hidden = !view;
    document.body.classList.toggle("chosen", Boolean(view));
    find("hint").replaceChildren(...(view ? [thumbnails[selected].title] : HINT));
    if (view) {
      find("photo").replaceChildren(picture(view.photo, view, true));
      find("predicted").hidden = find("different").hidden = !view.prediction;
      find("worth").textContent = worth(view);
      if (view.prediction) {
        find("prediction").replaceChildren(picture(view.prediction, view, false));
        const difference = picture(view.photo, view, false);
        difference.append(make("img", { src: view.prediction, alt: "" }));
        find("difference").replaceChildren(difference);
        clip(difference, view);
      }
    }
    scene?.stand(view);
  };
  const step = (by) => {
    const count = data.views.length;
    const index = selected < 0 ? (by > 0 ? 0 : count - 1) : (selected + by + count) % count;
    if (index === selected) return;
    const strip = find("thumbnails"), thumbnail = thumbnails[index];
    strip.scrollTo(thumbnail.offsetLeft - (strip.clientWidth - thumbnail.offsetWidth) / 2,
      thumbnail.offsetTop - (strip.clientHeight - thumbnail.offsetHeight) / 2);
    if (thumbnails.includes(document.activeElement)) thumbnail.focus({ preventScroll: true });
    select(index);
  };
  find("previous").addEventListener("click", () => step(-1));
  find("next").addEventListener("click", () => step(1));
  document.addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (by && !event.target.closest("input[type=range], #lamp, .scroll")) {
      event.preventDefault();
      step(by);
    } else if (event.key === "Escape") {
      document.activeElement.blur(); // of a slider, which uses arrow keys itself
      if (selected >= 0) select(selected);
    }
  });
  for (const slider of document.querySelectorAll("input[type=range]")) {
    slider.addEventListener("pointerup", () => slider.blur()); // else it would keep the arrow keys
  }

  // ---- Tables ------------------------------------------------------------------------------

  const cell = (value, kind) => {
    if (kind === "text") return make("td", { class: kind }, ...prose(value));
    if (kind !== "bar") return make("td", { class: kind, text: value });
    const bar = make("i");
    bar.style.width = `${100 * value}%`;
    return make("td", { class: kind }, bar);
  };
  // Columns are pairs of title and kind; a row that is a string is a heading.
  const table = (columns, rows) => {
    const head = make("tr", {}, ...columns.map(([text, kind]) => make("th", { class: kind, text })));
    const body = rows.map((row) => Array.isArray(row)
      ? make("tr", {}, ...row.map((value, at) => cell(value, columns[at][1])))
      : make("tr", { class: "heading" }, make("th", { colspan: columns.length, text: row })));
    return make("div", { class: "scroll" }, make("table", {}, make("thead", {}, head), make("tbody", {}, ...body)));
  };
  const section = (title, ...parts) =>
    find("sections").append(make("section", {}, make("h2", { text: title }), ...parts));
  const folded = (title, ...parts) =>
    find("sections").append(make("details", {}, make("summary", { text: title }), ...parts));
  const faint = (text) => make("p", { class: "faint" }, ...prose(text));
  const some = (names) => names.slice(0, 8).join(", ") + (names.length > 8 ? ` and ${names.length - 8} more` : "");

  const { score, text: verdict } = summary.verdict || { score: 1, text: "" };
  find("verdict").append(...prose(verdict));
  find("verdict").classList.toggle("doubtful", score < 0.5);
  find("verdict").hidden = !verdict;
  // Each sentence once: the verdict on a bad result is also a warning, and contains the diagnosis.
  const warnings = [...new Set([summary.diagnosis || "", ...(summary.warnings || [])])]
    .filter((text) => !verdict.includes(text));
  section("Warnings", warnings.length
    ? make("ul", {}, ...warnings.map((text) => make("li", {}, ...prose(text)))) : faint("None."));

  const relit = summary.relighting;
  if (relit && relit.psnr_db !== null) {
    const decibels = (value) => value === null || value === undefined ? "" : value.toFixed(2);
    const materials = relit.materials.map((one) => `${(100 * one.vertices).toFixed(0)} % metallic `
      + `${digits(one.metallic, 2)}, roughness ${digits(one.roughness, 2)}, specular ${digits(one.specular, 2)}`);
    const origin = relit.photographs === "held out" ? "that were held out of the run" : "from which the surface was made";
    const textured = decibels(relit.psnr_textured_db);
    folded("Photographs predicted from the surface",
      faint(`Each photograph under its fitted light; photographs ${origin}`
        + `${textured && `. With the asset's textures ${textured} dB on average`}. Materials: ${materials.join("; ")}.`),
      table([["photograph", "name"], ["PSNR with materials, dB", "number"], ["matte, dB", "number"], ["", "text"]],
        [{ name: "mean", ...relit }, ...relit.views].map((one) =>
          [one.name, decibels(one.psnr_db), decibels(one.psnr_matte_db), ""])));
  }

  const longest = Math.max(...summary.stages.map((stage) => stage.kept ? 0 : stage.seconds)) || 1;
  const figures = ({ name, seconds, peak_memory_mb, kept, ...rest }) => Object.entries(rest)
    .filter(([, value]) => value !== null)
    .map(([key, value]) => `${key.replaceAll("_", " ")} ${Number.isInteger(value) ? thousands(value) : digits(value, 4)}`)
    .join(", ");
  folded("Stages",
    faint(`${summary.seconds.toFixed(0)} s up to this page, at most ${(summary.peak_memory_mb || 0).toFixed(0)} MB`
      + `${summary.peak_memory_stage ? `, in ${summary.peak_memory_stage}` : ""}`),
    table([["stage", "name"], ["seconds", "number"], ["", "bar"], ["peak MB", "number"], ["figures", "text"]],
      summary.stages.map((stage) => [stage.name, stage.kept ? "kept" : stage.seconds.toFixed(1),
        stage.kept ? 0 : stage.seconds / longest, stage.peak_memory_mb.toFixed(0), figures(stage)])));

  if (data.left_out.length) {
    folded("Left out", faint("Significant removals by guards; `summary.json` lists all."),
      table([["guard", "name"], ["removed", "number"], ["of", "number"], ["", "name"], ["reason", "text"]],
        data.left_out.flatMap(({ heading, entries }) => [heading, ...entries.map((one) =>
          [one.guard, thousands(one.count), thousands(one.total), one.what,
            one.reason + (one.names.length ? `: ${some(one.names)}` : "")])])));
  }
  if (summary.failures.length) {
    section("Failed", table(["stage", "what", "reason", "done"].map((title) => [title, "text"]),
      summary.failures.map((one) => [one.stage, `${one.what} ${some(one.names)}`, one.reason, one.done])));
  }
  folded("Settings", table([["setting", "name"], ["value", "text"]],
    Object.entries(data.settings).flatMap(([name, value]) =>
      typeof value === "string" ? [[name, value]] : [name, ...Object.entries(value)])));

  // ---- The surface -------------------------------------------------------------------------

  const VIRIDIS = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"];
  const [NEAR, FAR, FOV_DEG] = [0.01, 100, 30]; // planes in units of the scene's radius
  const MARKED = 2.7; // maximum distance of drawn cameras, in radii: the surface then has a third of the image
  const ORBIT_MS = 8000; // of one turn of the lamp
  const REMOTE = 1e-3; // the surface's radius over the distance of a distant light
  // Coefficients of spherical harmonics for an irradiance of 1, and for 1 where the surface faces an axis.
  const [EVEN, ALONG] = [Math.PI / 0.886227, Math.PI / (2 * 0.511664)];
  const HATCHING = `
    if (!gl_FrontFacing) gl_FragColor.rgb = vec3(0.3);
    if (!gl_FrontFacing || vSeen < 0.5)
      gl_FragColor.rgb *= mix(0.4, 1.0, step(0.5, fract((gl_FragCoord.x + gl_FragCoord.y) / 9.0)));
  `;
  const SAMPLES = 240; // of a profile: about one per pixel of its curve
  const TOOLS = { measure: "Click the first point on the surface.", profile: "Draw a line over the surface." };
  const length = (distance) => `${digits(data.unit.factor * distance, 3)} ${data.unit.name}`;
  const save = (suffix, blob) => {
    const href = URL.createObjectURL(blob);
    make("a", { download: `${data.title}.${suffix}`, href }).click();
    setTimeout(() => URL.revokeObjectURL(href), 60000);
  };
  const OPENGL = new THREE.Matrix4().makeScale(1, -1, -1); // from x right, y down, z forward

  class Surface {
    constructor(object) {
      this.stage = find("stage");
      this.canvas = find("canvas");
      this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
      this.camera = new THREE.PerspectiveCamera(FOV_DEG, 1, 1, 10);
      this.world = new THREE.Scene();
      this.object = object;
      const { scene_from_asset: back } = object.userData; // cameras are in the scene's frame
      if (back) object.geometry.applyMatrix4(new THREE.Matrix4().fromArray(back));
      object.geometry.computeBoundingSphere();
      ({ center: this.center, radius: this.radius } = object.geometry.boundingSphere);
      object.geometry.computeBoundingBox();
      const box = object.geometry.boundingBox; // distances of lights are in units of its half diagonal
      this.middle = { center: box.getCenter(new THREE.Vector3()), radius: box.min.distanceTo(box.max) / 2 };
      this.up = vector(data.up);
      this.light = new THREE.PointLight();
      this.ambient = new THREE.AmbientLight();
      this.probe = new THREE.LightProbe(); // light from all sides that depends on the normal, unlike ambient light
      this.shade = { value: 1 }; // 1 if the surface occludes the sky
      this.addBytes("openness", 255);
      this.addBytes("seen", 1);
      this.markers = new THREE.Group();
      this.lamps = new THREE.Group();
      this.markers.visible = this.lamps.visible = false;
      this.world.add(object, this.light, this.ambient, this.probe, this.markers, this.lamps);
      this.lamp = { view: new THREE.Vector3(-0.45, 0.55, 0.7).normalize(), fitted: null };
      this.raking = new THREE.Vector3(-0.8, 0.5, 0.3).normalize(); // the lamp of `shape`
      this.orbiting = false;
      this.behind = null; // the photograph whose viewpoint is used
      this.layers = this.makeLayers();
      this.makeMarkers();
      this.controls = new THREE.OrbitControls(this.camera, this.canvas);
      this.makeRuler();
      let held = false; // a click without dragging keeps the photograph's viewpoint
      this.controls.addEventListener("start", () => { held = true; });
      this.controls.addEventListener("end", () => { held = false; });
      this.controls.addEventListener("change", () => {
        if (held) this.leave();
        this.draw();
      });
      this.listen();
      this.home();
      new ResizeObserver(() => this.resize()).observe(this.stage);
    }

    // Values per vertex: the visible fraction of the sky, and whether a photograph shows it.
    addBytes(name, one) {
      const values = Float32Array.from(atob(data[name]), (each) => each.charCodeAt(0) / one);
      this.object.geometry.setAttribute(name, new THREE.Float32BufferAttribute(values, 1));
    }

    // Hatch inner sides and what no photograph shows; attenuate light from all sides by `shade` and
    // the visible fraction of the sky.
    finish(material, shade) {
      material.onBeforeCompile = (shader) => {
        shader.uniforms.shade = shade;
        shader.vertexShader = "attribute float openness, seen; varying float vOpenness, vSeen;\n" + shader.vertexShader
          .replace("#include <begin_vertex>", "#include <begin_vertex>\nvOpenness = openness; vSeen = seen;");
        shader.fragmentShader = "uniform float shade; varying float vOpenness, vSeen;\n" + shader.fragmentShader
          .replace("#include <aomap_fragment>", "reflectedLight.indirectDiffuse *= mix(1.0, vOpenness, shade);")
          .replace(/}\s*$/, `${HATCHING}}`);
      };
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
        this.finish(layer.material, layer.unlit ? { value: 0 } : this.shade);
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
      this.showLamp();
      this.draw();
    }

    showLamp() {
      const shown = !this.shown.unlit && find("lit").checked;
      find("lamp").style.display = find("orbit").style.display = shown ? "" : "none";
      this.orbit(false);
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
        // Drawn position: on the line of sight, near enough that the surface remains large.
        const away = view.place.distanceTo(this.center), shown = Math.min(away, MARKED * this.radius);
        view.marker = view.place.clone().sub(this.center).multiplyScalar(shown / away).add(this.center);
        const size = 0.08 * shown;
        const [fx, fy] = view.focal, [cx, cy] = view.centre;
        const corners = [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]].map(
          ([x, y]) => new THREE.Vector3((x - cx) / fx, (y - cy) / fy, 1).multiplyScalar(size)
            .applyMatrix4(view.worldFromCamera).sub(view.place).add(view.marker));
        corners.forEach((corner, at) => lines.push(view.marker, corner, corner, corners[(at + 1) % 4]));
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

    // Points of the surface and lines between them, drawn over it: of `measure` and `profile`.
    makeRuler() {
      const look = { color: 0xffd24a, depthTest: false, transparent: true };
      const geometry = new THREE.BufferGeometry();
      this.ruler = new THREE.Group();
      this.ruler.add(new THREE.LineSegments(geometry, new THREE.LineBasicMaterial(look)),
        new THREE.Points(geometry, new THREE.PointsMaterial({ ...look, size: 9, sizeAttenuation: false })));
      for (const one of this.ruler.children) one.frustumCulled = false;
      this.world.add(this.ruler);
      for (const tool of Object.keys(TOOLS)) find(tool).addEventListener("click", () => this.use(tool));
      this.use(null);
    }

    // Start a tool; the one in use is stopped.
    use(tool) {
      this.tool = this.tool === tool ? null : tool;
      for (const name of Object.keys(TOOLS)) find(name).setAttribute("aria-pressed", String(this.tool === name));
      find("measured").hidden = !this.tool;
      this.controls.enableRotate = this.tool !== "profile"; // a line is drawn instead
      this.ends = [];
      this.report(TOOLS[this.tool] || "", []);
    }

    // Show a text, the curve of a profile, and lines over the surface.
    report(text, line, curve = null) {
      find("measured").textContent = text;
      find("graph").toggleAttribute("hidden", !curve);
      if (curve) this.plot(curve);
      this.ruler.visible = line.length > 0;
      this.ruler.children[1].visible = !curve;
      this.ruler.children.forEach((one) => one.geometry.dispose());
      const geometry = new THREE.BufferGeometry().setFromPoints(line);
      for (const one of this.ruler.children) one.geometry = geometry;
      this.draw();
    }

    // Add an end point of the distance.
    mark(place) {
      this.ends = [...this.ends.slice(0, this.ends.length % 2), place];
      const [first, last] = [this.ends[0], this.ends.at(-1)];
      this.report(this.ends.length < 2 ? "Click the second point on the surface."
        : length(first.distanceTo(last)), [first, last]);
    }

    // The ray through a point of the window.
    caster(x, y) {
      const box = this.canvas.getBoundingClientRect();
      const caster = new THREE.Raycaster();
      caster.setFromCamera(new THREE.Vector2(2 * (x - box.left) / box.width - 1,
        1 - 2 * (y - box.top) / box.height), this.camera);
      return caster;
    }

    // The facets that a plane cuts, as a surface.
    cut(normal, origin) {
      const { index, attributes: { position } } = this.object.geometry, place = new THREE.Vector3();
      const sides = Array.from({ length: position.count },
        (_, at) => place.fromBufferAttribute(position, at).sub(origin).dot(normal) > 0);
      const corners = [];
      for (let at = 0; at < index.count; at += 3) {
        const [a, b, c] = [index.getX(at), index.getX(at + 1), index.getX(at + 2)];
        if (sides[a] !== sides[b] || sides[a] !== sides[c]) corners.push(a, b, c);
      }
      const geometry = new THREE.BufferGeometry().setAttribute("position", position).setIndex(corners);
      geometry.boundingSphere = this.object.geometry.boundingSphere;
      return new THREE.Mesh(geometry, this.object.material);
    }

    // Section of the surface under a line of the window: height over the line between the ends.
    profile([x0, y0], [x1, y1]) {
      const eye = this.camera.position;
      const [first, last] = [this.caster(x0, y0), this.caster(x1, y1)].map((one) => one.ray.direction);
      const normal = first.clone().cross(last).normalize();
      const facets = this.cut(normal, eye);
      const hits = Array.from({ length: SAMPLES }, (_, at) => {
        const share = at / (SAMPLES - 1);
        return this.caster(x0 + share * (x1 - x0), y0 + share * (y1 - y0)).intersectObject(facets)[0]?.point;
      });
      const found = hits.filter(Boolean), start = found[0];
      if (found.length < 2) return this.report("The line misses the surface.", []);
      const along = found.at(-1).clone().sub(start).normalize(), up = along.clone().cross(normal);
      if (up.dot(eye.clone().sub(start)) < 0) up.negate();
      const { factor } = data.unit;
      const curve = hits.map((hit) => hit && [along, up].map((axis) => factor * hit.clone().sub(start).dot(axis)));
      const line = hits.flatMap((hit, at) => hit && hits[at + 1] ? [hit, hits[at + 1]] : []);
      return this.report(`${length(start.distanceTo(found.at(-1)))} from end to end`, line, curve);
    }

    // Draw heights; gaps remain where the line misses the surface.
    plot(curve) {
      const found = curve.filter(Boolean), [xs, ys] = [0, 1].map((at) => found.map((one) => one[at]));
      const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
      find("graph").querySelector(".curve").setAttribute("d", curve.map((one, at) => one
        && `${curve[at - 1] ? "L" : "M"}${52 + 224 * (one[0] - left) / (right - left || 1)} `
          + `${98 - 90 * (one[1] - low) / (high - low || 1)}`).join(""));
      const texts = [high, low, left, right].map((one) => digits(Math.abs(one) < 1e-6 * right ? 0 : one, 3));
      find("graph").querySelectorAll("text").forEach((one, at) => { one.textContent = texts[at]; });
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
      find("lit").addEventListener("change", () => { this.showLamp(); this.draw(); });
      find("orbit").addEventListener("click", () => this.orbit(!this.orbiting));
      const environment = find("environment");
      environment.parentElement.hidden = !data.views.some((view) => view.environment);
      environment.addEventListener("change", () => {
        find("lit").checked = !environment.checked; // the environment includes the lamp's light
        this.showLamp();
        this.draw();
      });
      find("full").hidden = !document.fullscreenEnabled;
      find("full").addEventListener("click", () => document.fullscreenElement
        ? document.exitFullscreen() : find("viewer").requestFullscreen());
      document.addEventListener("fullscreenchange", () =>
        find("full").setAttribute("aria-pressed", String(Boolean(document.fullscreenElement))));
      find("home").addEventListener("click", () => { if (selected >= 0) select(selected); this.home(); });
      find("opacity").addEventListener("input", () => this.fade());
      const lamp = find("lamp");
      const point = (event) => {
        const box = lamp.getBoundingClientRect();
        this.orbit(false);
        this.aim((2.3 * (event.clientX - box.left)) / box.width - 1.15,
          1.15 - (2.3 * (event.clientY - box.top)) / box.height);
      };
      lamp.addEventListener("pointerdown", (event) => { lamp.setPointerCapture(event.pointerId); point(event); });
      lamp.addEventListener("pointermove", (event) => { if (event.buttons) point(event); });
      lamp.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
        if (!step) return;
        event.preventDefault();
        this.orbit(false);
        const { x, y } = this.direction();
        this.aim(x + step[0], y + step[1]);
      });
      let down = null; // where the primary pointer was pressed
      this.canvas.addEventListener("pointerdown", (event) => {
        down = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null;
      });
      this.canvas.addEventListener("pointermove", (event) => {
        if (down && event.buttons && this.tool === "profile") this.profile(down, [event.clientX, event.clientY]);
      });
      this.canvas.addEventListener("pointerup", (event) => {
        const still = down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 5;
        down = null;
        if (!still) return;
        const place = this.tool === "measure" && this.caster(event.clientX, event.clientY).intersectObject(this.object)[0];
        if (place) this.mark(place.point);
        else if (!this.tool) this.pick(event);
      });
      find("save-picture").addEventListener("click", () => {
        this.drawNow(); // the canvas is empty after a frame
        this.canvas.toBlob((blob) => save("png", blob));
      });
      find("save-mesh").addEventListener("click", () => save("ply", new Blob(this.ply())));
    }

    // The surface as binary PLY in the frame of mesh.ply, without the cuts of its texture.
    ply() {
      const { index, attributes: { position, normal } } = this.object.geometry;
      const { offset_world: offset = [0, 0, 0] } = this.object.userData;
      const numbers = new Map(), kept = [];
      const welded = Array.from({ length: position.count }, (_, at) => {
        const key = [position.getX(at), position.getY(at), position.getZ(at)].join();
        if (!numbers.has(key)) numbers.set(key, kept.push(at) - 1);
        return numbers.get(key);
      });
      const header = ["ply", "format binary_little_endian 1.0", `element vertex ${kept.length}`,
        ...["x", "y", "z"].map((one) => `property double ${one}`),
        ...["nx", "ny", "nz"].map((one) => `property float ${one}`),
        `element face ${index.count / 3}`, "property list uchar int vertex_indices", "end_header", ""];
      const vertices = new DataView(new ArrayBuffer(36 * kept.length));
      kept.forEach((at, row) => ["getX", "getY", "getZ"].forEach((get, axis) => {
        vertices.setFloat64(36 * row + 8 * axis, position[get](at) + offset[axis], true);
        vertices.setFloat32(36 * row + 24 + 4 * axis, normal[get](at), true);
      }));
      const faces = new DataView(new ArrayBuffer((13 * index.count) / 3));
      for (let face = 0; face < index.count / 3; face++) {
        faces.setUint8(13 * face, 3);
        for (let at = 0; at < 3; at++) faces.setInt32(13 * face + 1 + 4 * at, welded[index.getX(3 * face + at)], true);
      }
      return [header.join("\n"), vertices, faces];
    }

    // Set the light to a point of the hemisphere on the viewer's side.
    aim(x, y) {
      const length = Math.hypot(x, y);
      const shrink = Math.min(1, 0.999 / (length || 1));
      [x, y] = [x * shrink, y * shrink];
      const towards = new THREE.Vector3(x, y, Math.sqrt(1 - x * x - y * y));
      if (this.plain) this.raking = towards;
      else this.lamp = { view: towards, fitted: null };
      this.draw();
    }

    // Let the lamp circle clockwise, at its distance from the middle of the disc; or stop it.
    orbit(wanted) {
      find("orbit").setAttribute("aria-pressed", String(wanted));
      if (this.orbiting === wanted) return;
      this.orbiting = wanted;
      let { x, y } = this.direction();
      if (Math.hypot(x, y) < 0.3) [x, y] = [0, 0.9]; // a circle that changes little
      const [away, start] = [Math.hypot(x, y), Math.atan2(y, x)];
      let began = null;
      const turn = (now) => {
        if (!this.orbiting) return;
        const angle = start - (2 * Math.PI * (now - (began ??= now))) / ORBIT_MS;
        this.aim(away * Math.cos(angle), away * Math.sin(angle));
        requestAnimationFrame(turn);
      };
      if (wanted) requestAnimationFrame(turn);
    }

    // `shape` has a light of its own for all photographs: a lamp behind the camera would flatten it.
    get plain() { return this.shown.title === "shape"; }

    get fitted() { return this.plain ? null : this.lamp.fitted; }

    direction() {
      if (!this.fitted) return this.plain ? this.raking : this.lamp.view;
      return vector(this.fitted.direction).transformDirection(this.camera.matrixWorldInverse);
    }

    pick(event) {
      if (!this.markers.visible) return;
      const box = this.canvas.getBoundingClientRect();
      let [best, nearest] = [-1, 18];
      data.views.forEach((view, index) => {
        const seen = view.marker.clone().project(this.camera);
        const away = Math.hypot((seen.x + 1) * box.width / 2 - (event.clientX - box.left),
          (1 - seen.y) * box.height / 2 - (event.clientY - box.top));
        if (seen.z < 1 && away < nearest) [best, nearest] = [index, away];
      });
      if (best >= 0 && best !== selected) select(best);
    }

    home() {
      const reference = data.views[data.reference];
      const towards = reference.place.clone().sub(this.center).normalize();
      const shown = [...(this.markers.visible ? data.views.map((view) => view.marker) : []),
        ...(this.lamps.visible ? this.bulbs : [])];
      const farthest = Math.max(this.radius, ...shown.map((place) => place.distanceTo(this.center)));
      this.reach = 1.08 * farthest / Math.sin((FOV_DEG * Math.PI) / 360);
      this.camera.up.copy(this.up);
      this.camera.position.copy(this.center).addScaledVector(towards, this.reach);
      this.controls.target.copy(this.center);
      this.leave(true);
      this.controls.update();
    }

    // Move to the viewpoint of a photograph, under its light; or leave it.
    stand(view) {
      if (!view) {
        this.lamp.fitted = null;
        return this.leave(true);
      }
      this.behind = view;
      if (!this.plain) this.orbit(false); // the lamp goes to the photograph's light
      find("fade").hidden = false;
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
      // Narrow images have the horizontal field of view that square ones have vertically.
      const half = Math.tan((FOV_DEG * Math.PI) / 360) / Math.min(1, width / height);
      this.camera.fov = (360 / Math.PI) * Math.atan(half);
      this.camera.updateProjectionMatrix();
      if (this.behind) this.frame(width, height, near, far);
      this.fade();
      this.draw();
    }

    // The photograph's pinhole, scaled to fit into the canvas.
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

    // First-order light from all sides: that of photographs, or a sky that is brighter above.
    surroundings() {
      if (!find("environment").checked) {
        const ambient = Number(find("ambient").value) * (this.plain ? 1.5 : 1);
        return [ambient, this.up.clone().normalize().multiplyScalar(0.6 * ambient)];
      }
      const own = data.views[selected]?.environment;
      const known = own ? [own] : data.views.flatMap((view) => view.environment ? [view.environment] : []);
      const mean = [0, 1, 2, 3].map((at) => known.reduce((sum, one) => sum + one[at], 0) / known.length);
      const along = vector(mean.slice(1));
      const exposure = 1 / Math.max(mean[0] + along.length(), 1e-6); // lights are up to a scale
      return [exposure * mean[0], along.multiplyScalar(exposure)];
    }

    shineFromAllSides(even, along) {
      const { coefficients } = this.probe.sh;
      coefficients[0].setScalar(EVEN * even);
      [along.y, along.z, along.x].forEach((one, at) => coefficients[at + 1].setScalar(ALONG * one));
    }

    drawNow() {
      this.camera.updateMatrixWorld();
      const towards = this.direction();
      const { fitted, plain } = this;
      const distance = this.middle.radius / Math.max(fitted?.inverse_distance ?? 0, REMOTE);
      this.light.position.copy(towards).transformDirection(this.camera.matrixWorld)
        .multiplyScalar(distance).add(this.middle.center);
      // Radiance is albedo times light here; the renderer divides it by pi, and by the squared
      // distance.
      const exact = fitted && !find("environment").checked;
      this.light.intensity = find("lit").checked ? (plain ? 0.75 : 1) * Math.PI * distance ** 2 : 0;
      this.light.color.setRGB(...(exact ? fitted.directed : [1, 1, 1]));
      this.ambient.intensity = exact ? Math.PI : 0;
      if (exact) this.ambient.color.setRGB(...fitted.ambient);
      this.shade.value = exact ? 0 : 1;
      this.probe.intensity = exact ? 0 : 1;
      this.shineFromAllSides(...this.surroundings());
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
    find("trouble").textContent = `The surface cannot be drawn: ${error.message || error}. The photographs and tables below do not need WebGL.`;
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
