"""The renderer obeys geometry and optics: projection, depth, falloff, shadow, gloss, noise, and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from builders import SavedImages, sphere
from cuspid.geometry import Rigid3
from cuspid.geometry.gloss import coat, transmittance
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.model.camera import Camera
from cuspid.model.capture import Frame
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Light, Lighting, Rig, Sensor
from cuspid.runtime import workers
from cuspid.runtime.errors import InputError
from cuspid.simulation import raycast
from cuspid.simulation.appearance import (
    APPEARANCES,
    GRADIENT_NOISE_SD,
    NO_MATERIAL,
    Appearance,
    Material,
    albedo,
    face_materials,
    gradient_noise,
    palette,
)
from cuspid.simulation.optics import Optics
from cuspid.simulation.raycast import (
    Scene,
    auto_gain,
    lamps,
    lit_frames,
    pixel_rays,
    radiance,
    render_capture,
    render_depth,
    render_image,
)
from cuspid.simulation.sensor import expose
from cuspid.simulation.shadows import AMBIENT
from ray_scenes import CAMERA, FACING, jaw_of, led, probe, quad

WHITE = Material(dark=(1.0, 1.0, 1.0), light=(1.0, 1.0, 1.0), wavelengths_mm=(1.0,))
BLACK = replace(WHITE, dark=(0.0, 0.0, 0.0), light=(0.0, 0.0, 0.0))
PLAIN = Appearance(enamel=WHITE, gum=BLACK)
SKEWED = Camera(
    width=160,
    height=120,
    focal_px=np.array([130.0, 125.0]),
    principal_point_px=np.array([71.3, 66.2]),
    distortion=np.array([-0.08, 0.02, 0.002, -0.003]),
)


def light_seen(jaw: Jaw, handpiece: Handpiece, appearance: Appearance = PLAIN, supersampling: int = 1) -> np.ndarray:
    """Green radiance in the image of the one camera at the origin."""
    scene = Scene(jaw=jaw, handpiece=handpiece, appearance=appearance, supersampling=supersampling)
    camera = handpiece.rig["a"].camera
    return radiance(scene, camera, FACING, lamps(handpiece, "all", Rigid3.identity()))[..., 1]


def at(image: np.ndarray, camera: Camera, point: tuple[float, float, float]) -> float:
    """The pixel that a point falls into."""
    x, y = np.floor(camera.project(np.array(point))).astype(int)
    return float(image[y, x])


# --- geometry -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("marker", [(0.0, 0.0, 4.0), (-1.5, 1.1, 5.0), (1.4, 1.2, 6.0), (2.0, -1.3, 5.5)])
@pytest.mark.parametrize("side", [-0.2, 0.2])
def test_a_marker_appears_where_the_camera_projects_it(marker: tuple[float, float, float], side: float) -> None:
    jaw = jaw_of(quad(marker, 0.12), quad((0, 0, 9.0), 20.0), labels=[11, 0])
    # The lamp beside the camera throws the marker's shadow on the wall behind, just where the marker's edge is.
    image = light_seen(jaw, probe(led(x=side, y=side), camera=SKEWED), supersampling=6)
    weights = image / image.sum()
    centroid = np.sum(weights[..., None] * SKEWED.pixel_centres(), axis=(0, 1))
    np.testing.assert_allclose(centroid, SKEWED.project(np.array(marker)), atol=0.1)


def test_depth_of_a_plane_is_exact_also_through_a_distorting_lens() -> None:
    turn = Rigid3.from_rotation_vector(np.array([0.2, -0.3, 0.1]), np.array([0.1, 0.2, 6.0]))
    corners, faces = quad((0, 0, 0), 30.0)
    plane = Mesh(corners, faces)
    normal, offset = turn.rotation[:, 2], turn.rotation[:, 2] @ turn.translation
    expected = offset / (SKEWED.rays(SKEWED.pixel_centres()) @ normal)
    np.testing.assert_allclose(render_depth(plane, SKEWED, turn), expected, atol=2e-5)


def test_depth_of_a_sphere_and_nothing_beside_it() -> None:
    depth = render_depth(sphere(2.0, 6), CAMERA, Rigid3(np.eye(3), np.array([0, 0, 7.0])))
    rays = CAMERA.rays(CAMERA.pixel_centres())
    squared = np.sum(rays**2, axis=-1)
    discriminant = (7 * rays[..., 2]) ** 2 - squared * (49 - 4)
    with np.errstate(invalid="ignore"):
        expected = (7 * rays[..., 2] - np.sqrt(discriminant)) / squared
    clear = np.abs(discriminant) > 0.5
    np.testing.assert_allclose(depth[clear], expected[clear], atol=2e-3)
    assert np.isnan(depth).any()


def test_supersampling_measures_the_covered_share_of_a_pixel() -> None:
    half = 3.0 * 40.3 / CAMERA.focal_px[0]
    image = light_seen(jaw_of(quad((0, 0, 3.0), half)), probe(led(z=-1000, power=1e6)), supersampling=5)
    inside, edge, outside = image[50, 60], image[50, 60 + 40], image[50, 60 + 41]
    assert edge / inside == pytest.approx(0.3, abs=0.11)
    assert outside == 0


# --- light --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance_mm", "power"), [(2.0, 1.0), (4.0, 1.0), (8.0, 3.0)])
def test_light_falls_off_with_the_squared_distance(distance_mm: float, power: float) -> None:
    image = light_seen(jaw_of(quad((0, 0, distance_mm), 50.0)), probe(led(power=power)))
    assert image[50, 60] == pytest.approx((1 + AMBIENT) * power / distance_mm**2, rel=1e-3)


@pytest.mark.parametrize("exponent", [1.0, 3.0])
def test_light_follows_lamberts_law_and_the_lobe_of_the_lamp(exponent: float) -> None:
    image = light_seen(jaw_of(quad((0, 0, 5.0), 50.0)), probe(led(lobe_exponent=exponent)))
    x, y = 110, 50
    ray = CAMERA.rays(CAMERA.pixel_centres())[y, x]
    cosine = 1 / np.linalg.norm(ray)
    falloff = cosine**exponent * cosine**2 / 25
    assert image[y, x] == pytest.approx((cosine + AMBIENT) * falloff, rel=1e-4)
    assert cosine < 0.95


def test_lights_add_up_and_only_those_that_are_on_shine() -> None:
    jaw = jaw_of(quad((0, 0, 5.0), 50.0))
    one, other = led(x=-1.0), led(x=2.0, power=2.0)
    both = probe(one, other)
    np.testing.assert_allclose(
        light_seen(jaw, both), light_seen(jaw, probe(one)) + light_seen(jaw, probe(other)), rtol=1e-3
    )
    first_only = replace(both, lightings=(Lighting(name="all", lights=("led0",)),))
    np.testing.assert_array_equal(light_seen(jaw, first_only), light_seen(jaw, probe(one)))


def test_a_blocker_throws_a_shadow_where_it_should() -> None:
    blocker, wall = quad((1.0, 0, 3.0), 0.3), quad((0, 0, 6.0), 50.0)
    lamp = led(x=2.0)
    free, blocked = light_seen(jaw_of(wall), probe(lamp)), light_seen(jaw_of(blocker, wall), probe(lamp))
    in_shadow, ambient_only = (0.0, 0.0, 6.0), AMBIENT / (1 / np.hypot(2, 6) * 6 + AMBIENT)
    ratio = at(blocked, CAMERA, in_shadow) / at(free, CAMERA, in_shadow)
    assert ratio == pytest.approx(ambient_only, rel=0.01)
    for lit in ((-0.9, 0.0, 6.0), (0.0, 0.8, 6.0)):
        assert at(blocked, CAMERA, lit) == pytest.approx(at(free, CAMERA, lit), rel=1e-6)


def test_the_coat_reflects_its_fresnel_share_and_no_more() -> None:
    """The integral over all directions of light of a nearly smooth coat is its Fresnel reflectance."""
    steps = 200
    cosines, azimuths = (np.arange(steps) + 0.5) / steps, (np.arange(2 * steps) + 0.5) / steps * np.pi
    view = np.array([np.sin(0.5), 0, np.cos(0.5)])
    total = 0.0
    for cosine in cosines:
        for azimuth in azimuths:
            sine = np.sqrt(1 - cosine**2)
            half = view + [sine * np.cos(azimuth), sine * np.sin(azimuth), cosine]
            half /= np.linalg.norm(half)
            total += coat(cosine, view[2], half[2], half @ view, 0.05, 0.1)[0] / np.pi
    total *= (1 / steps) * (np.pi / steps)
    assert total == pytest.approx(0.05, rel=0.05)


def test_gloss_depends_on_the_direction_of_view_and_matte_does_not() -> None:
    jaw = jaw_of(quad((0, 0, 5.0), 50.0))
    glossy = Appearance(enamel=replace(WHITE, reflectance=0.05, roughness=0.1), gum=BLACK)
    lamp = led(x=2.0)
    matte_image, glossy_image = (light_seen(jaw, probe(lamp), look) for look in (PLAIN, glossy))
    mirror = (1.0, 0.0, 5.0)
    assert at(glossy_image, CAMERA, mirror) > 1.5 * at(matte_image, CAMERA, mirror)
    beside = (-2.0, 0.0, 5.0)
    assert 0.9 < at(glossy_image, CAMERA, beside) / at(matte_image, CAMERA, beside) < 1.0


def test_less_light_leaves_a_clear_surface_at_grazing_angles() -> None:
    jaw = jaw_of(quad((0, 0, 5.0), 50.0))
    clear = Appearance(enamel=replace(WHITE, exit_index=1.5), gum=BLACK)
    wide = Camera.from_field_of_view(CAMERA.width, CAMERA.height, 130.0)
    matte_image, clear_image = (light_seen(jaw, probe(led(x=2.0), camera=wide), look) for look in (PLAIN, clear))
    rays = wide.rays(wide.pixel_centres().reshape(-1, 2))
    cosines = (1 / np.linalg.norm(rays, axis=-1)).reshape(matte_image.shape)
    expected = np.vectorize(transmittance)(cosines, 1.5)
    assert expected.min() < 0.95
    np.testing.assert_allclose(clear_image / matte_image, expected, rtol=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.03, 0.5])
def test_crossed_polarisers_let_a_share_of_the_mirror_reflection_through(share: float) -> None:
    jaw = jaw_of(quad((0, 0, 5.0), 50.0))
    glossy = Appearance(enamel=replace(WHITE, reflectance=0.05, roughness=0.1), gum=BLACK)
    none, some, whole = (light_seen(jaw, probe(led(x=2.0, glare=glare)), glossy) for glare in (0.0, share, 1.0))
    mirror = (1.0, 0.0, 5.0)
    gloss = at(whole, CAMERA, mirror) - at(none, CAMERA, mirror)
    assert gloss > 0.3 * at(none, CAMERA, mirror)
    assert at(some, CAMERA, mirror) - at(none, CAMERA, mirror) == pytest.approx(share * gloss, abs=1e-6)


def test_exposure_is_metered_by_the_brightest_channel_under_coloured_lights() -> None:
    jaw, poses = jaw_of(quad((0, 0, 5.0), 50.0)), [Rigid3.identity()]

    def gain(*lights: Light) -> float:
        return auto_gain(Scene(jaw=jaw, handpiece=probe(*lights), appearance=PLAIN), poses, "all")

    red, green = (replace(led(), colour=colour) for colour in (np.array([1.0, 0, 0]), np.array([0, 0.5, 0])))
    assert gain(red) == pytest.approx(gain(led()))
    assert gain(red, green) == pytest.approx(gain(red), rel=1e-3)


# --- texture ------------------------------------------------------------------------------------------------------


def test_texture_belongs_to_the_jaw_not_to_the_camera() -> None:
    """Two cameras side by side under the same light see a plane shifted by a whole number of pixels."""
    jaw, shift = jaw_of(quad((0, 0, 5.0), 50.0)), 17
    scene = Scene(jaw=jaw, handpiece=probe(led()), appearance=APPEARANCES["artificial"])
    lights = lamps(scene.handpiece, "all", Rigid3.identity())
    aside = Rigid3(np.eye(3), np.array([-shift * 5.0 / CAMERA.focal_px[0], 0, 0]))
    here, there = radiance(scene, CAMERA, FACING, lights), radiance(scene, CAMERA, aside, lights)
    np.testing.assert_allclose(here[:, shift:], there[:, :-shift], rtol=2e-3)
    assert here.std() > 0.3 * here.mean()


def test_noise_has_zero_mean_the_stated_deviation_and_is_continuous() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-200, 200, (40_000, 3))
    values = np.array([gradient_noise(*point) for point in points])
    near = np.array([gradient_noise(*(point + 1e-6)) for point in points[:2000]])
    assert abs(values.mean()) < 0.01
    assert values.std() == pytest.approx(GRADIENT_NOISE_SD, rel=0.03)
    assert np.abs(near - values[:2000]).max() < 1e-5


def test_albedo_is_the_sum_of_the_octaves_at_each_point_and_black_where_nothing_is() -> None:
    points, look = np.random.default_rng(0).uniform(-20, 20, (300, 3)), palette(APPEARANCES["enamel"], 0)
    materials = np.tile(np.array([0, 1, NO_MATERIAL], dtype=np.uint8), 100)
    shown = albedo(points, materials, look)
    for point, material, colour in zip(points, materials, shown, strict=True):
        if material == NO_MATERIAL:
            assert not colour.any()
            continue
        octaves = look.noise_from_jaw[material, : look.octaves[material]]
        unit = sum(gradient_noise(*(m[:, :3] @ point + m[:, 3])) for m in octaves) / GRADIENT_NOISE_SD
        share = 1 / (1 + np.exp(-look.hardness[material] * unit / np.sqrt(len(octaves))))
        np.testing.assert_allclose(colour, look.dark[material] + share * (look.light - look.dark)[material], rtol=1e-9)


def test_veins_are_thin_red_and_leave_the_rest_of_the_gum_as_it_is() -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (20_000, 3))
    gum = np.ones(len(points), dtype=np.uint8)
    bare, veined = (albedo(points, gum, palette(APPEARANCES[name], 3)) for name in ("enamel", "natural"))
    vein = np.array(APPEARANCES["natural"].gum.veins)
    share = (bare - veined) / (bare - vein)
    assert np.ptp(share, axis=1).max() < 1e-9  # the same of all colours: what is below is mixed with the vein
    assert share.min() > -1e-12
    assert share.max() < 1
    assert 0.7 < (share[:, 0] < 0.01).mean() < 0.95
    assert 0.005 < (share[:, 0] > 0.5).mean() < 0.1


def test_presets_differ_in_contrast_and_seeds_in_pattern() -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (10_000, 3))
    enamel = np.zeros(len(points), dtype=np.uint8)
    contrast = {}
    for name, appearance in APPEARANCES.items():
        grey = albedo(points, enamel, palette(appearance, 0)).mean(axis=1)
        contrast[name] = grey.std() / grey.mean()
        assert 0 < grey.min() < grey.max() < 1
    assert contrast["artificial"] > 0.4 > 0.15 > contrast["powder"] > 0.05
    assert contrast["enamel"] < 0.1
    one, other = (albedo(points, enamel, palette(APPEARANCES["artificial"], seed)).mean(axis=1) for seed in (0, 1))
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.05


def test_a_sprayed_texture_suits_the_cameras_and_enamel_stays_enamel() -> None:
    for footprint_mm, factor in ((0.0117, 1), (0.003, 1), (0.053, 1), (0.1, 8), (0.0015, 0.125), (12.0, 1024)):
        for name in ("artificial", "powder"):
            before, after = APPEARANCES[name].gum, APPEARANCES[name].at_footprint(footprint_mm).gum
            assert after.wavelengths_mm == tuple(factor * wavelength for wavelength in before.wavelengths_mm)
        assert (
            APPEARANCES["enamel"].at_footprint(footprint_mm).gum.wavelengths_mm
            == APPEARANCES["enamel"].gum.wavelengths_mm
        )


def test_gum_and_teeth_have_their_own_materials() -> None:
    two = jaw_of(quad((0, 0, 5.0), 1.0), quad((3, 0, 5.0), 1.0), labels=[11, 0])
    np.testing.assert_array_equal(face_materials(two), [0, 0, 1, 1])
    np.testing.assert_array_equal(face_materials(replace(two, face_labels=None)), 0)
    red = [palette(APPEARANCES["enamel"], 0).light[k] for k in (0, 1)]
    assert red[1][0] / red[1][2] > 1.5 * red[0][0] / red[0][2]


# --- sensor -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level_dn", [25.0, 127.5, 220.0])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_noise_has_the_asked_deviation_and_no_bias(level_dn: float, share: float) -> None:
    sensor = Sensor(noise_dn=1.5, shot_noise_share=share)
    grey = np.full((200, 200, 3), (level_dn / 255) ** sensor.gamma)
    image = expose(grey, 1.0, sensor, np.random.default_rng(3)).astype(float)
    expected = 1.5 * np.sqrt(1 - share + share * level_dn / 127.5)
    assert float(sensor.noise_sd_dn(np.array([level_dn]))[0]) == pytest.approx(expected)
    assert image.std() == pytest.approx(np.hypot(expected, np.sqrt(1 / 12)), rel=0.02)
    assert image.mean() == pytest.approx(level_dn, abs=0.03)


def test_full_scale_saturates_and_gain_scales_linear_light() -> None:
    sensor = Sensor(noise_dn=0.0, gamma=2.2)
    light = np.full((1, 1, 3), 0.1)
    assert expose(light, 20.0, sensor, np.random.default_rng(0)).max() == 255
    assert expose(light, 2.0, sensor, np.random.default_rng(0))[0, 0, 0] == round(255 * 0.2 ** (1 / 2.2))


def test_exposure_burns_little_and_uses_the_range(coarse_phantom: Jaw) -> None:
    handpiece = twelve_cameras(DesignOptions(width_px=60, height_px=60))
    scene = Scene(jaw=coarse_phantom, handpiece=handpiece, appearance=APPEARANCES["artificial"], supersampling=1)
    pose = Rigid3(np.eye(3), -_over(coarse_phantom, 46))
    gain, frame = auto_gain(scene, [pose]), Frame(name="0", cameras=handpiece.rig.names)
    images = np.concatenate([render_image(scene, frame, name, pose, gain) for name in frame.cameras])
    assert np.mean(images >= 254) < 0.03
    assert 190 < np.percentile(images, 97) < 255


def _over(jaw: Jaw, tooth: int) -> np.ndarray:
    """The middle of the top of a tooth."""
    points = jaw.mesh.face_centres[jaw.tooth_faces(tooth)]
    return np.array([*points[:, :2].mean(axis=0), points[:, 2].max() - 1.0])


# --- captures -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(coarse_phantom: Jaw) -> Scene:
    handpiece = twelve_cameras(DesignOptions(width_px=40, height_px=40))
    few = Rig({name: handpiece.rig[name] for name in ("o1", "b2", "l3")})
    return Scene(jaw=coarse_phantom, handpiece=replace(handpiece, rig=few), appearance=APPEARANCES["powder"], seed=5)


@pytest.fixture(scope="module")
def poses(scene: Scene) -> dict[str, Rigid3]:
    return {f"{k:05d}": Rigid3(np.eye(3), -_over(scene.jaw, 46) + [0.5 * k, 0, 0]) for k in range(3)}


def rendered(scene: Scene, poses: dict[str, Rigid3], **options: object) -> dict[tuple[str, str], np.ndarray]:
    images: dict[tuple[str, str], np.ndarray] = {}
    taken = lit_frames(scene.handpiece, poses)
    done = list(render_capture(scene, *taken, lambda f, c, image: images.update({(f, c): image}), **options))  # type: ignore[arg-type]
    assert sorted(done) == sorted(images)
    return images


def test_a_resumed_capture_equals_an_uninterrupted_one(scene: Scene, poses: dict[str, Rigid3]) -> None:
    whole = rendered(scene, poses)
    assert set(whole) == {(frame, camera) for frame in poses for camera in scene.handpiece.rig.names}
    first_half = set(list(whole)[:4])
    rest = rendered(scene, poses, skip=lambda frame, camera: (frame, camera) in first_half)
    assert set(rest) == set(whole) - first_half
    for key, image in rest.items():
        np.testing.assert_array_equal(image, whole[key])


def test_rays_that_are_remembered_are_those_of_the_camera(scene: Scene) -> None:
    for camera in (SKEWED, CAMERA, SKEWED, SKEWED):
        np.testing.assert_array_equal(scene.rays(camera), pixel_rays(camera, scene.supersampling))


def test_light_does_not_depend_on_what_is_shaded_at_once(
    scene: Scene, poses: dict[str, Rigid3], monkeypatch: pytest.MonkeyPatch
) -> None:
    lights = lamps(scene.handpiece, "all", poses["00000"])
    cam_from_world = scene.handpiece.rig["o1"].cam_from_rig @ poses["00000"]
    whole = radiance(scene, SKEWED, cam_from_world, lights)
    monkeypatch.setattr(raycast, "_BLOCK", 1000)
    np.testing.assert_array_equal(radiance(scene, SKEWED, cam_from_world, lights), whole)
    assert whole.any()


@pytest.mark.long
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_processes_give_the_same_images_as_one(
    scene: Scene, poses: dict[str, Rigid3], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    monkeypatch.setattr(workers, "START_METHOD", method)
    whole = rendered(scene, poses)
    frames = lit_frames(scene.handpiece, poses)
    done = list(render_capture(scene, *frames, SavedImages(tmp_path), processes=2))
    assert sorted(done) == sorted(whole)
    for (frame, camera), image in whole.items():
        np.testing.assert_array_equal(np.load(tmp_path / f"{frame}-{camera}.npy"), image)


def test_light_below_the_surface_is_found_once_for_each_frame(
    scene: Scene, poses: dict[str, Rigid3], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many frames are remembered, the images are the same, and while all are, each is found once."""
    asked = list[int]()
    entering = raycast._entering_light

    def counted(scene: Scene, lights: Lamps) -> np.ndarray:
        asked.append(1)
        return entering(scene, lights)

    monkeypatch.setattr(raycast, "_entering_light", counted)
    found = []
    for together in (1, 2, 3):
        monkeypatch.setattr(raycast, "_TOGETHER", together)
        wet = replace(scene, appearance=APPEARANCES["enamel"], optics=Optics(scattering=1.0))
        asked.clear()
        found.append(rendered(wet, poses))
        assert len(poses) <= len(asked) <= (1 if together == len(poses) else 2) * len(poses)  # metering asks, too
    assert sorted(found[0]) == sorted(rendered(scene, poses))
    for other in found[1:]:
        for key, image in other.items():
            np.testing.assert_array_equal(image, found[0][key])


def test_each_lighting_pattern_lights_its_own_frames(scene: Scene, poses: dict[str, Rigid3]) -> None:
    """Whatever the patterns are called: a frame for each at each pose, exposed alike, each by its own lights."""
    one, *_, other = scene.handpiece.lights
    patterns = (Lighting(name="left side", lights=(one,)), Lighting(name="Ü2", lights=(other,)))
    turns = replace(scene, handpiece=replace(scene.handpiece, lightings=patterns))
    images = rendered(turns, poses)
    assert {frame for frame, _ in images} == {f"{name}{letter}" for name in poses for letter in "ab"}
    for pattern, letter in zip(patterns, "ab", strict=True):
        alone = replace(scene, handpiece=replace(scene.handpiece, lightings=(pattern,)))
        for (frame, camera), image in rendered(alone, poses).items():
            apart = images[f"{frame}{letter}", camera].astype(float) - image
            assert np.abs(apart).mean() < 3 * turns.handpiece.sensor.noise_dn
    assert np.abs(images["00000a", "o1"].astype(float) - images["00000b", "o1"]).mean() > 10


def test_noise_differs_between_images_and_seeds(scene: Scene, poses: dict[str, Rigid3]) -> None:
    pose = poses["00000"]
    a, b = (Frame(name=name, cameras=("o1",), lighting="all") for name in "ab")
    one, same, other = (render_image(scene, frame, "o1", pose, 1.0).astype(int) for frame in (a, a, b))
    np.testing.assert_array_equal(one, same)
    assert (one - other).std() == pytest.approx(1.5 * np.sqrt(2), rel=0.3)


def test_what_cannot_be_rendered_is_said(scene: Scene) -> None:
    with pytest.raises(InputError, match="no lighting pattern named 'left'; it has all"):
        lamps(scene.handpiece, "left", Rigid3.identity())
    with pytest.raises(InputError, match="no camera sees the jaw"):
        auto_gain(scene, [Rigid3(np.eye(3), np.array([0, 0, 500.0]))])
