"""Metashape's cameras in XML (Agisoft Metashape Professional, user manual, appendix "Camera models"): the principal
point is relative to the middle of the image, p1 and p2 are OpenCV's p2 and p1, the focal lengths are f + b1 and f, b2
is skew, and transforms are ``chunk_from_camera`` with OpenCV's axes."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, number, quote
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import Calibration, Hints, camera, image_size, motion
from cuspid.storage.calibrations.lenses import BROWN_5, FISHEYE_TANGENTIAL, Lens, Loss, fit_projection
from cuspid.storage.units import Unit

LENSES: tuple[Lens, ...] = (BROWN_5, FISHEYE_TANGENTIAL)
_MOST = 1e6
_COEFFICIENTS = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")


def recognises(files: Mapping[str, Document]) -> bool:
    """Whether it is a document with sensors and cameras."""
    document, *others = files.values()
    return not others and document.kind == "xml" and document.value.find(".//sensor") is not None


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """The cameras that are aligned; others are left out, and said. Raises InputError."""
    (document,) = files.values()
    chunk = document.value.find(".//chunk")
    if chunk is None:
        raise InputError("it has no chunk; export the cameras as Agisoft XML")
    sensors = {each.get("id"): each for each in chunk.iterfind("sensors/sensor")}
    known: dict[str | None, tuple[Camera, Loss | None]] = {}
    cameras: dict[str, MountedCamera] = {}
    losses: dict[str, Loss] = {}
    unplaced = 0
    elements = [*chunk.iterfind("cameras/camera"), *chunk.iterfind("cameras/group/camera")]
    for element in elements:
        words = (element.findtext("transform") or "").split()
        if not words:
            unplaced += 1
            continue
        name = checked_name("camera label", (element.get("label") or "").rsplit(".", 1)[0] or element.get("id"))
        if name in cameras:
            name = checked_name("camera", f"{name}-{element.get('id')}")
        sensor = element.get("sensor_id")
        if sensor not in sensors:
            raise InputError(f"camera {name}: it has no sensor {quote(sensor)}")
        if sensor not in known:
            known[sensor] = _camera(f"sensor {sensor}", sensors[sensor])
        made, loss = known[sensor]
        chunk_from_camera = motion(f"camera {name}: transform", [float(each) for each in words])
        cameras[name] = MountedCamera(made, chunk_from_camera.inverse())
        losses.update({} if loss is None else {name: loss})
    if not cameras:
        raise InputError("none of its cameras is aligned")
    scale, unit = _scale(chunk, elements)
    notes = [f"{unplaced} cameras are not aligned, and are left out"] if unplaced else []
    if unit is None:
        notes.append("its chunk has no scale: lengths are in an arbitrary unit")
    placed = {
        name: MountedCamera(each.camera, Rigid3(each.cam_from_rig.rotation, each.cam_from_rig.translation * scale))
        for name, each in cameras.items()
    }
    return Calibration(cameras=placed, unit=unit, losses=losses, notes=tuple(notes))


def _scale(chunk: Element, elements: list[Element]) -> tuple[float, Unit | None]:
    """Metres per unit of the transforms, where the chunk, or the component of its cameras, has a scale."""
    used = {each.get("component_id") for each in elements} - {None}
    candidates = [chunk.findtext("transform/scale")]
    candidates += [
        each.findtext("transform/scale") for each in chunk.iterfind("components/component") if each.get("id") in used
    ]
    found = {float(each) for each in candidates if each}
    if len(found) > 1:
        raise InputError("its components have different scales; export the chunk with one of them")
    if not found:
        return 1.0, None
    return number("scale", found.pop(), 1e-9, 1e9), "m"


def _camera(what: str, sensor: Element) -> tuple[Camera, Loss | None]:
    found = sensor.findall("calibration")
    adjusted = [each for each in found if each.get("class") == "adjusted"] or found
    if not adjusted:
        raise InputError(f"{what}: it has no calibration")
    calibration = adjusted[0]
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise InputError(f"{what}: it has no resolution")
    size = image_size(what, *(float(resolution.get(each, "nan")) for each in ("width", "height")))
    focal = calibration.findtext("f")
    if focal is None:
        raise InputError(f"{what}: its calibration has no f; export it with a newer version of Metashape")
    f = number(f"{what}: f", float(focal), 1.0, 1e7)
    cx, cy, b1, b2, k1, k2, k3, k4, p1, p2 = (
        number(f"{what}: {each}", float(calibration.findtext(each) or 0), -_MOST, _MOST) for each in _COEFFICIENTS
    )
    kind = calibration.get("type", sensor.get("type", "frame"))
    if kind not in ("frame", "fisheye"):
        raise InputError(f"{what}: type {quote(kind)} is not supported; only frame and fisheye are")
    focal_px, centre = [f + b1, f], [size[0] / 2 + cx, size[1] / 2 + cy]
    if kind == "fisheye":
        model, values = "THIN_PRISM_FISHEYE", [k1, k2, p2, p1, k3, k4, 0.0, 0.0]
    elif k3 == 0:
        model, values = "OPENCV", [k1, k2, p2, p1]
    else:
        model, values = "FULL_OPENCV", [k1, k2, p2, p1, k3, 0.0, 0.0, 0.0]
    made = camera(what, size, focal_px, centre, values, model, pixel_offset=0.0)
    if b2 == 0 and (k4 == 0 or kind == "fisheye"):
        return made, None

    def project(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """With k4 r^8, and with skew, which no model of COLMAP's has."""
        pixels = made.project(points)
        if kind == "frame":
            plane = points[:, :2] / np.where(points[:, 2:] > 1e-6, points[:, 2:], np.nan)
            pixels = pixels + k4 * (plane**2).sum(axis=1, keepdims=True) ** 4 * plane * made.focal_px
        skew = b2 * (pixels[:, 1] - centre[1]) / f
        return pixels + np.stack([skew, np.zeros(len(skew))], axis=1)

    more = " and ".join(name for name, value in (("b2", b2), ("k4", k4)) if value)
    return fit_projection(project, size, f"a lens with {more}")


def write(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """A chunk with a sensor for each camera and the scale 1: metres."""
    document = ElementTree.Element("document", version="2.0.0")
    chunk = ElementTree.SubElement(document, "chunk", label="cuspid", enabled="true")
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(cameras)))
    places = ElementTree.SubElement(chunk, "cameras", next_id=str(len(cameras)), next_group_id="0")
    for index, (name, mounted) in enumerate(cameras.items()):
        made = mounted.camera
        kind = "fisheye" if made.lens.is_equidistant else "frame"
        size = {"width": str(made.width), "height": str(made.height)}
        sensor = ElementTree.SubElement(sensors, "sensor", id=str(index), label=name, type=kind)
        ElementTree.SubElement(sensor, "resolution", size)
        calibration = ElementTree.SubElement(sensor, "calibration", {"type": kind, "class": "adjusted"})
        ElementTree.SubElement(calibration, "resolution", size)
        for field, value in _fields(made).items():
            ElementTree.SubElement(calibration, field).text = repr(float(value))
        place = ElementTree.SubElement(
            places, "camera", id=str(index), sensor_id=str(index), label=name, enabled="true"
        )
        transform = mounted.cam_from_rig.inverse().matrix.ravel().tolist()
        ElementTree.SubElement(place, "transform").text = " ".join(map(repr, transform))
    world_from_chunk = ElementTree.SubElement(chunk, "transform")
    ElementTree.SubElement(world_from_chunk, "rotation").text = "1 0 0 0 1 0 0 0 1"
    ElementTree.SubElement(world_from_chunk, "translation").text = "0 0 0"
    ElementTree.SubElement(world_from_chunk, "scale").text = "1"
    ElementTree.indent(document)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(document, encoding="unicode") + "\n"


def _fields(made: Camera) -> dict[str, float]:
    fx, fy = made.focal_px.tolist()
    cx, cy = made.principal_point_px.tolist()
    lens = dict(zip(made.lens.names, made.distortion.tolist(), strict=True))
    return {
        "f": fy,
        "cx": cx - made.width / 2,
        "cy": cy - made.height / 2,
        "b1": fx - fy,
        "k1": lens["k1"],
        "k2": lens["k2"],
        "k3": lens.get("k3", 0.0),
        "k4": lens.get("k4", 0.0),
        "p1": lens["p2"],
        "p2": lens["p1"],
    }
