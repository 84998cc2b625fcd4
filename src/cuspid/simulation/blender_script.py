"""Runs inside Blender's Python (bpy, numpy): renders the scene that :mod:`cuspid.simulation.blender` wrote to a folder.

Usage: ``python blender_script.py FOLDER``. Reads ``scene.json`` and ``mesh.npz``, writes the linear light of each image
as ``<frame>-<camera>.npy`` (h, w, 3) and then prints ``rendered <frame> <camera>``. One Blender unit is a millimetre.
"""

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np

GRADIENT_NOISE_SD = 0.27 / 2
"""Standard deviation of Blender's noise texture, which maps gradient noise to 0..1."""


def main(folder: Path) -> None:
    """Render every image that the scene file asks for."""
    description = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    set_up_cycles(description)
    materials = [build_material(each) for each in description["materials"]]
    add_jaw(folder / "mesh.npz", materials)
    for task in description["images"]:
        camera = place_camera(task["camera"])
        lights = [add_light(light) for light in task["lights"]]
        render(folder, task)
        for light in [camera, *lights]:
            bpy.data.objects.remove(light)
        print("rendered", task["frame"], task["name"], flush=True)


def set_up_cycles(description: dict[str, Any]) -> None:
    """Path tracing on the CPU, a box filter of one pixel, linear output."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = description["samples"]
    scene.cycles.use_adaptive_sampling = False
    # A denoiser would smear a fine texture; light scattered under the surface has none, and needs it.
    scene.cycles.use_denoising = any(any(each["scattering_mm"]) for each in description["materials"])
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.sample_clamp_indirect = 0
    scene.render.threads_mode, scene.render.threads = "FIXED", description["threads"]
    scene.render.use_persistent_data = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.world = bpy.data.worlds.new("dark")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0


def add_jaw(path: Path, materials: list[Any]) -> None:
    """The jaw with smooth normals and a material for each face."""
    arrays = np.load(path)
    mesh = bpy.data.meshes.new("jaw")
    mesh.from_pydata(arrays["vertices"], [], arrays["faces"].tolist())
    for material in materials:
        mesh.materials.append(material)
    mesh.polygons.foreach_set("material_index", arrays["materials"].astype(np.int32))
    mesh.shade_smooth()
    bpy.context.collection.objects.link(bpy.data.objects.new("jaw", mesh))


def build_material(description: dict[str, Any]) -> Any:
    """A principled material whose colour is mixed by octaves of a solid noise."""
    material = bpy.data.materials.new("material")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Principled BSDF"]
    mix = nodes.new("ShaderNodeMix")
    mix.data_type = "RGBA"
    links.new(texture_share(nodes, links, description), mix.inputs["Factor"])
    mix.inputs[6].default_value = (*description["dark"], 1)
    mix.inputs[7].default_value = (*description["light"], 1)
    links.new(mix.outputs[2], surface.inputs["Base Color"])
    root = np.sqrt(description["reflectance"])
    surface.inputs["IOR"].default_value = (1 + root) / (1 - root)
    surface.inputs["Specular IOR Level"].default_value = 0.5 if root > 0 else 0.0
    surface.inputs["Roughness"].default_value = np.sqrt(description["roughness"])
    if any(description["scattering_mm"]):
        surface.inputs["Subsurface Weight"].default_value = 1.0
        surface.inputs["Subsurface Radius"].default_value = description["scattering_mm"]
        surface.inputs["Subsurface Scale"].default_value = 1.0
    return material


def texture_share(nodes: Any, links: Any, description: dict[str, Any]) -> Any:
    """Socket with the share of the light colour: the logistic of the summed octaves."""
    place = nodes.new("ShaderNodeNewGeometry").outputs["Position"]
    total = None
    for index, wavelength in enumerate(description["wavelengths_mm"]):
        mapping = nodes.new("ShaderNodeMapping")
        mapping.inputs["Location"].default_value = np.array([17.1, 31.7, 57.3]) * (index + 1)
        mapping.inputs["Rotation"].default_value = np.array([0.5, 0.9, 1.3]) * (index + 1)
        noise = nodes.new("ShaderNodeTexNoise")
        noise.inputs["Scale"].default_value = 1 / wavelength
        noise.inputs["Detail"].default_value = 0
        links.new(place, mapping.inputs["Vector"])
        links.new(mapping.outputs["Vector"], noise.inputs["Vector"])
        value = arithmetic(nodes, links, "SUBTRACT", noise.outputs[0], 0.5)
        total = value if total is None else arithmetic(nodes, links, "ADD", total, value)
    scale = description["hardness"] / (GRADIENT_NOISE_SD * np.sqrt(len(description["wavelengths_mm"])))
    power = arithmetic(nodes, links, "POWER", float(np.e), arithmetic(nodes, links, "MULTIPLY", total, -scale))
    return arithmetic(nodes, links, "DIVIDE", 1.0, arithmetic(nodes, links, "ADD", power, 1.0))


def arithmetic(nodes: Any, links: Any, operation: str, first: Any, second: Any) -> Any:
    """Socket with the result of an operation on sockets or numbers."""
    node = nodes.new("ShaderNodeMath")
    node.operation = operation
    for slot, value in enumerate((first, second)):
        if isinstance(value, float):
            node.inputs[slot].default_value = value
        else:
            links.new(value, node.inputs[slot])
    return node.outputs[0]


def place_camera(description: dict[str, Any]) -> Any:
    """A camera with any focal lengths and principal point. Blender's cameras look along -Z with +Y up."""
    width, height = description["width"], description["height"]
    (fx, fy), (cx, cy) = description["focal_px"], description["principal_point_px"]
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = fx * data.sensor_width / width
    data.shift_x = (width / 2 - cx) / width
    data.shift_y = (cy - height / 2) / width * fx / fy
    data.clip_start, data.clip_end = 0.05, 1000.0
    camera = bpy.data.objects.new("camera", data)
    camera.matrix_world = matrix(np.array(description["world_from_cam"]) @ np.diag([1, -1, -1, 1]))
    bpy.context.collection.objects.link(camera)
    scene.camera = camera
    return camera


def add_light(description: dict[str, Any]) -> Any:
    """A small disc that emits according to Lambert's law, like a bare LED."""
    data = bpy.data.lights.new("led", "AREA")
    data.shape, data.size = "DISK", description["diameter_mm"]
    data.energy = np.pi**2 * description["power"]
    data.color = description["colour"]
    light = bpy.data.objects.new("led", data)
    light.matrix_world = matrix(np.array(description["world_from_light"]))
    light.visible_camera = False
    bpy.context.collection.objects.link(light)
    return light


def matrix(rows: Any) -> Any:
    """A 4x4 array as Blender takes it."""
    return mathutils.Matrix(rows.tolist())


def render(folder: Path, task: dict[str, Any]) -> None:
    """Render one image and leave its linear light as an array."""
    scene = bpy.context.scene
    scene.cycles.seed = task["seed"]
    scene.render.filepath = str(folder / "image.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    width, height = image.size
    pixels = np.empty(width * height * 4, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    np.save(folder / f"{task['frame']}-{task['name']}.npy", pixels.reshape(height, width, 4)[::-1, :, :3])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
