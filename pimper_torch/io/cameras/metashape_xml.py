"""Cameras of Agisoft Metashape (PhotoScan): the XML that "Export Cameras" writes."""

from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring
from xml.parsers import expat

from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.rigid import invert_rigid, rigid
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.posed_camera import PosedCamera, opencv_lens
from pimper_torch.records import CameraModel
from pimper_torch.records.shapes import Pose
from pimper_torch.runtime.errors import InputError, caution, some

KIND = "a Metashape camera XML"


def read_metashape(path: Path, *_: object) -> list[PosedCamera]:
    """Read the cameras, named by their labels in Metashape.

    A camera's ``transform`` is ``chunk_from_cam``, row by row, with our camera axes. The
    transform of the chunk (of the camera's ``component`` in newer files) is a similarity from
    there to the world, which is applied if it exists; for a georeferenced chunk that world is
    geocentric. The manual's appendix "Camera models" defines the lens: ``f``, with ``b1``
    added along x; ``cx``, ``cy`` from (width / 2, height / 2) in a frame with the centre of the
    top-left pixel at (0.5, 0.5), like ours; ``p1`` and ``p2`` are swapped relative to OpenCV.

    Cameras without a transform are not aligned and are skipped, as are disabled ones. Each chunk,
    and each component of a chunk, has a separate frame: several chunks with aligned cameras are an
    error; of several components the largest is read, with a warning.

    Raises:
        InputError: The file is something else, declares a document type, or has a lens or rig
            that is not supported.
    """
    file = DataSetPath(path, KIND)
    chunk = _chunk(file)
    lenses = {
        str(sensor.get("id")): (sensor, number)
        for number, sensor in enumerate(chunk.iterfind("sensors//sensor"), start=1)
    }
    for camera in chunk.iterfind("cameras//camera"):
        needed = f"an independent transform for {camera.get('label')}"
        alone = camera.get("master_id") in (None, camera.get("id"))
        file.expect(alone, needed, "a camera of a rig")
    cameras = []
    for camera in _largest_component(_aligned(chunk), path):
        label = str(camera.get("label"))
        sensor = lenses.get(str(camera.get("sensor_id")))
        if sensor is None:
            file.refuse(f"the sensor of {label}", "no sensor with this id")
        lens, skew_px = _lens(*sensor, file)
        pose = _cam_from_world(camera, chunk, file)
        cameras.append(PosedCamera(name=label, cam_from_world=pose, lens=lens, skew_px=skew_px))
    file.expect(bool(cameras), "cameras with a transform", "none")
    return cameras


def parse_without_entities(path: Path) -> Element:
    """Parse untrusted XML; a document type declaration is an error.

    Entities need one. They allow a small file to grow without bound, or to refer to other files.
    """

    def refuse(name: str, *_: object) -> None:
        raise InputError(
            f"{path}: declares the document type {name}; needed: XML without a document type. "
            "Export it again."
        )

    content = path.read_bytes()
    checker = expat.ParserCreate()
    checker.StartDoctypeDeclHandler = refuse
    checker.Parse(content, True)
    return fromstring(content)


def _chunk(file: DataSetPath) -> Element:
    root = file.read(parse_without_entities, "XML")
    chunks = [root] if root.tag == "chunk" else root.findall("chunk")
    file.expect(bool(chunks), "a document with one chunk", f"<{root.tag}> without a chunk")
    aligned = [chunk for chunk in chunks if _aligned(chunk)] or chunks
    if len(aligned) > 1:
        labels = [f"{chunk.get('label')} ({len(_aligned(chunk))} cameras)" for chunk in aligned]
        raise InputError(
            f"{file.path}: has {len(aligned)} chunks: {some(labels)}; needed: one, as each has a "
            "separate frame. Export the cameras of the chunk you want, or merge the chunks."
        )
    return aligned[0]


def _aligned(chunk: Element) -> list[Element]:
    """List the enabled cameras that have a transform."""
    return [
        camera
        for camera in chunk.iterfind("cameras//camera")
        if camera.find("transform") is not None and camera.get("enabled") not in ("0", "false")
    ]


def _largest_component(cameras: list[Element], path: Path) -> list[Element]:
    sizes = Counter(camera.get("component_id") for camera in cameras).most_common()
    if len(sizes) < 2:
        return cameras
    (largest, size), *rest = sizes
    caution(
        f"{path}: its cameras are in {len(sizes)} components with separate frames. The component "
        f"of {size} cameras is used, not {some([f'that of {count}' for _, count in rest])}. Align "
        "the components in Metashape to use all cameras.",
        stacklevel=4,
    )
    return [camera for camera in cameras if camera.get("component_id") == largest]


def _cam_from_world(camera: Element, chunk: Element, file: DataSetPath) -> Pose:
    what = f"transform of {camera.get('label')}"
    chunk_from_cam = file.numbers(camera.findtext("transform"), 16, what).reshape(4, 4)
    pose = file.rigid(chunk_from_cam[:3, :3], chunk_from_cam[:3, 3], what)
    components = {
        component.get("id"): component.find("transform")
        for component in chunk.iterfind("components/component")
    }
    similarity = components.get(camera.get("component_id"))
    similarity = chunk.find("transform") if similarity is None else similarity
    if similarity is None:
        return invert_rigid(pose)

    def values(tag: str, count: int, default: str) -> Float[Tensor, " value"]:
        return file.numbers(similarity.findtext(tag, default), count, f"{tag} of the chunk")

    rotation = values("rotation", 9, "1 0 0 0 1 0 0 0 1").reshape(3, 3)
    shift, scale = values("translation", 3, "0 0 0"), float(values("scale", 1, "1"))
    file.expect(scale > 0, "a positive scale of the chunk", f"{scale}")
    world_from_chunk = file.rigid(rotation, shift, "the chunk's transform")
    # In any unit: the scale moves the camera, and its axes keep unit length.
    return invert_rigid(world_from_chunk @ rigid(pose[:3, :3], scale * pose[:3, 3]))


def _lens(sensor: Element, number: int, file: DataSetPath) -> tuple[CameraModel, float]:
    """Return the lens of a sensor's calibration, and its skew in pixels."""
    label = sensor.get("label") or sensor.get("id")
    calibrations = sensor.findall("calibration")
    adjusted = [each for each in calibrations if each.get("class") == "adjusted"] or calibrations
    file.expect(bool(adjusted), f"a calibration of the sensor {label}", "none")
    calibration = adjusted[0]

    def value(tag: str) -> float:
        text = calibration.findtext(tag, "0")
        return float(file.numbers(text, 1, f"{tag} of the sensor {label}"))

    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    sides = None if resolution is None else [resolution.get("width"), resolution.get("height")]
    size_px = file.numbers(sides, 2, f"resolution of the sensor {label}")
    width, height = (int(side) for side in size_px)
    old = calibration.find("f") is None and calibration.find("fx") is not None
    other = "fx and fy of an old PhotoScan; export with a newer version" if old else "none"
    file.expect(value("f") > 0 and not old, f"a positive f of the sensor {label}", other)
    f, b1, b2 = value("f"), value("b1"), value("b2")
    k1, k2, k3, k4 = (value(tag) for tag in ("k1", "k2", "k3", "k4"))
    p1, p2, p3, p4 = (value(tag) for tag in ("p1", "p2", "p3", "p4"))
    pinhole = (f + b1, f, width / 2 + value("cx"), height / 2 + value("cy"))
    kind = calibration.get("type") or sensor.get("type") or "frame"
    lens = opencv_lens((width, height), pinhole, (k1, k2, p2, p1, k3), number)
    supported = kind == "frame" and not any((k4, p3, p4)) and not (b2 and lens.model != "PINHOLE")
    if kind == "fisheye":
        lens = lens.replace(model="OPENCV_FISHEYE", params=(*pinhole, k1, k2, k3, k4))
        supported = not any((p1, p2, p3, p4, b2))
    nonzero = [e.tag for e in calibration if (e.text or "").strip() not in ("", "0", "0.0")]
    file.expect(
        supported,
        f"a frame camera with k1, k2, k3, p1, p2, b1, or a fisheye with k1 to k4 and b1, for the "
        f"sensor {label}",
        f"a {kind} camera with {', '.join(nonzero)}; export undistorted photographs with their "
        "cameras, or align again without the other parameters",
    )
    return lens, b2
