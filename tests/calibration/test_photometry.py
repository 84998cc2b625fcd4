"""What cameras make of light, and where the lights are, from photographs of a board: closed loops, laws, notes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from boards import options as board_options
from cuspid import storage
from cuspid.calibration.calibrate import RigCalibration, in_frame_of
from cuspid.calibration.corners import BoardView
from cuspid.calibration.noise import Noise
from cuspid.calibration.patches import clear_places
from cuspid.calibration.photometry import (
    Photometry,
    PhotometryOptions,
    _keep_unobservable_falloff,
    _numbers,
    calibrate_light,
    look_at_patches,
)
from cuspid.calibration.shading import Given, Samples, _model, polynomials, prior
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions, essential_four
from cuspid.model.board import Board
from cuspid.model.rig import Handpiece, Light, Sensor
from cuspid.runtime.errors import InputError
from cuspid.simulation.board_images import PhotographOptions, board_light, board_poses, take_photographs
from cuspid.simulation.manufacturing import ManufacturingOptions, sample_built
from cuspid.simulation.raycast import pixel_rays
from cuspid.simulation.sensor import expose, record
from verbs import refused, run

BOARD = Board(columns=9, rows=7, square_mm=0.7)
DRAWN = essential_four(DesignOptions(width_px=200, height_px=200))
BUILT = ManufacturingOptions(
    manufacturing_gain_pct=10.0,
    manufacturing_falloff_pct=30.0,
    manufacturing_gamma_pct=2.0,
    manufacturing_led_um=100.0,
    manufacturing_led_power_pct=10.0,
)


class Rehearsal:
    """Images of a board by a built handpiece, and where it was, as if the geometry had been found exactly."""

    def __init__(self, true: Handpiece, lit: str, seed: int = 0, instants: int = 12, exposure: float = 1.0) -> None:
        self.true = true
        how = PhotographOptions(instants=instants, supersampling=1, lit=lit, seed=seed)
        names = [f"{k:02d}" for k in range(instants)]
        lights = list(true.lights)
        self.images = {}
        poses = board_poses(true, BOARD, how)
        rng = np.random.default_rng(seed)
        rays = {camera: pixel_rays(mounted.camera, 1) for camera, mounted in true.rig.cameras.items()}
        if lit == "one-by-one":
            names = [f"{name}-{lights[(k + k // 4) % 4]}" for k, name in enumerate(names)]
        for name, pose in zip(names, poses, strict=True):
            on = [] if lit == "evenly" else lights if lit == "together" else [name.split("-")[1]]
            lamps = [true.lights[each].in_frame(pose.inverse()) for each in on]
            gain = exposure * (1.0 if lit == "evenly" else 6.0 if lit == "together" else 20.0)
            for camera, mounted in true.rig.cameras.items():
                light = board_light(BOARD, mounted.camera, rays[camera], mounted.cam_from_rig @ pose, lamps)
                self.images[camera, name] = record(light, gain, true, camera, rng)
        self.found = located(true, dict(zip(names, poses, strict=True)))

    def calibrated(
        self,
        drawn: Handpiece | None = None,
        options: PhotometryOptions = PhotometryOptions(),
        found: RigCalibration | None = None,
    ) -> Photometry:
        """What is found from the images."""
        found = found or self.found
        patches = look_at_patches(found, lambda *key: self.images[key], BOARD, options)
        return calibrate_light(found, patches, BOARD, drawn, options)


def shaken(case: Rehearsal, seed: int) -> RigCalibration:
    """Its boards placed with errors of 3 um and 0.03 degrees, as a calibration does."""
    sigma, rng = np.repeat([np.deg2rad(0.03), 0.003], 3), np.random.default_rng(seed)
    instants = dict.fromkeys(instant for _, instant in case.found.rig_from_view)
    pushes = {instant: sigma * rng.standard_normal(6) for instant in instants}
    boards = {
        (camera, instant): pose @ Rigid3.from_rotation_vector(pushes[instant][:3], pushes[instant][3:])
        for (camera, instant), pose in case.found.rig_from_view.items()
    }
    return replace(case.found, rig_from_view=boards)


def located(true: Handpiece, poses: Mapping[str, Rigid3]) -> RigCalibration:
    """A geometric calibration without error."""
    views = {}
    for camera, mounted in true.rig.cameras.items():
        for instant, pose in poses.items():
            pixels = mounted.camera.project((mounted.cam_from_rig @ pose).apply(BOARD.corners))
            seen = np.flatnonzero(mounted.camera.contains(pixels))
            views |= {(camera, instant): BoardView(seen, pixels[seen])} if len(seen) >= 6 else {}
    return RigCalibration(
        lenses={},
        rig=true.rig,
        sigma_px=0.1,
        bending_mm=np.zeros(3),
        body_from_board={},
        uneven_mm=None,
        loose_px=None,
        widened={},
        cameras={},
        pixels={},
        residuals={},
        views=views,
        rig_from_view={key: poses[key[1]] for key in views},
        distance_mm=5.0,
        notes=(),
    )


@cache
def rehearsal(lit: str, seed: int) -> Rehearsal:
    return Rehearsal(sample_built(DRAWN, replace(BUILT, manufacturing_seed=seed)), lit, seed)


def camera_errors(found: Photometry, true: Handpiece) -> np.ndarray:
    """Of (log gain, a, b, log gamma) of each camera, in directions that are not correlated, in standard deviations."""
    gains = np.log([true.sensor_of(name).gain for name in found.sensors])
    errors = []
    for (name, sensor), gain in zip(found.sensors.items(), gains - gains.mean(), strict=True):
        known = true.sensor_of(name)
        off = np.array([np.log(sensor.gain) - gain, *np.subtract(sensor.falloff, known.falloff), 0])
        off[3] = np.log(sensor.gamma / known.gamma)
        errors.append(np.linalg.solve(np.linalg.cholesky(sensor.covariance), off))
    return np.array(errors)


def light_errors(found: Photometry, true: Handpiece) -> np.ndarray:
    """Of the place and of the logarithm of the power of each light, in standard deviations."""
    powers = np.log([each.power for each in true.lights.values()])
    errors = []
    for (name, light), power in zip(found.lights.items(), powers - powers.mean(), strict=True):
        off = np.array([*(light.position_mm - true.lights[name].position_mm), np.log(light.power) - power])
        errors.append(off / np.sqrt(np.diag(light.covariance)))
    return np.array(errors)


def rms(errors: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.square(np.concatenate([each.ravel() for each in errors])))))


# --- closed loops ------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(("lit", "known"), [("evenly", False), ("together", False), ("together", True)])
def test_cameras_are_as_far_off_as_is_stated(lit, known):
    """Over three handpieces, under a light that is known or not."""
    errors = []
    for seed in range(3):
        case = rehearsal(lit, seed)
        found = case.calibrated(DRAWN if known else None)
        errors.append(camera_errors(found, case.true))
        assert all(each.held_out_pct < 0.5 * each.before_pct for each in found.cameras.values())
    assert 0.6 < rms(errors) < 1.5


@pytest.mark.long
def test_lights_one_by_one_are_as_far_off_as_is_stated():
    cameras, lights, before, after = [], [], [], []
    for seed in range(3):
        case = rehearsal("one-by-one", seed)
        found = case.calibrated(DRAWN, found=shaken(case, seed))
        assert found.light_deviation_pct.max() < 1
        assert not any("did not converge" in note for note in found.notes)
        cameras.append(camera_errors(found, case.true))
        lights.append(light_errors(found, case.true))
        for name, light in found.lights.items():
            after.append(light.position_mm - case.true.lights[name].position_mm)
            before.append(DRAWN.lights[name].position_mm - case.true.lights[name].position_mm)
    assert 0.6 < rms(cameras) < 1.5
    assert 0.6 < rms(lights) < 1.5
    assert rms(after) < 0.2 * rms(before)


def test_lights_all_at_once_are_hardly_told_apart():
    found = rehearsal("together", 0).calibrated(DRAWN, PhotometryOptions(led_um=50.0))
    one_by_one = rehearsal("one-by-one", 0).calibrated(DRAWN, PhotometryOptions(led_um=50.0))
    sigma, alone = (
        np.sqrt(np.mean([np.trace(light.covariance[:3, :3]) / 3 for light in each.lights.values()]))
        for each in (found, one_by_one)
    )
    assert 0.025 < sigma <= 0.05
    assert alone < 0.5 * sigma
    assert any("their positions cannot be determined" in note for note in found.notes)
    assert not any("their positions cannot be determined" in note for note in one_by_one.notes)


def test_noise_is_the_one_of_the_sensor():
    true = replace(DRAWN, sensors={"o1": Sensor(noise_dn=3.0, shot_noise_share=0.8)})
    found = Rehearsal(true, "evenly").calibrated(options=PhotometryOptions(clear_px=2.0))
    off = [(found.cameras[name].noise_dn - true.sensor_of(name).noise_dn) for name in true.rig.names]
    stated = np.array([each.noise_sigma_dn for each in found.cameras.values()])
    assert 0.2 < rms([np.array(off) / stated]) < 2
    assert (stated < 0.05 * np.array([each.noise_dn for each in found.cameras.values()])).all()
    for name, each in found.cameras.items():
        assert abs(each.shot_noise_share - true.sensor_of(name).shot_noise_share) < 0.15


# --- laws --------------------------------------------------------------------------------------------------------


def test_where_there_is_no_falloff_none_is_found():
    found = Rehearsal(DRAWN, "evenly", seed=5).calibrated(options=PhotometryOptions(gamma_pct=0.0))
    in_sigmas = [each.corner_loss_pct / each.corner_loss_sigma_pct for each in found.cameras.values()]
    assert 0 < rms([np.array(in_sigmas)]) < 2
    assert max(each.corner_loss_sigma_pct for each in found.cameras.values()) < 2


@pytest.mark.parametrize("sigma", [0.02, 0.8])
def test_a_falloff_that_the_images_do_not_tell_is_neither_stored_nor_stated(sigma: float):
    """It was stated as -89 ± 14 %."""
    given = Sensor(falloff=(-0.2, -0.1))
    found = replace(given, gain=1.1, falloff=(0.9, -0.3), covariance=np.diag([1e-4, sigma**2 / 8, sigma**2 / 8, 1e-3]))
    noise = Noise(read_dn2=1.0, per_dn=0.1, noise_sigma_dn=0.1, levels_dn=np.zeros(0), variances_dn2=np.zeros(0))
    numbers, stored, told = _numbers(found, noise), _keep_unobservable_falloff(found, given), sigma < 0.1
    assert (numbers["corner_loss_pct"] is not None) == told
    assert (numbers["corner_loss_sigma_pct"] is not None) == told
    assert stored.falloff == (found.falloff if told else given.falloff)
    assert stored.gain == found.gain


def test_a_brightness_common_to_all_changes_nothing():
    """All gains times k, and 1/k of the light."""
    true = rehearsal("evenly", 0).true
    brighter = replace(true, sensors={name: replace(each, gain=3 * each.gain) for name, each in true.sensors.items()})
    one = rehearsal("evenly", 0).calibrated()
    other = Rehearsal(brighter, "evenly", exposure=1 / 3).calibrated()
    for name, each in one.sensors.items():
        assert other.sensors[name].gain == pytest.approx(each.gain, rel=1e-6)
        assert other.sensors[name].falloff == pytest.approx(each.falloff, abs=1e-6)


def test_cameras_in_another_order_give_the_same():
    case = rehearsal("together", 1)
    rig = type(case.true.rig)({name: case.true.rig[name] for name in reversed(case.true.rig.names)})
    views = {key: case.found.views[key] for key in reversed(case.found.views)}
    turned = Rehearsal.__new__(Rehearsal)
    turned.images, turned.found = case.images, replace(case.found, rig=rig, views=views)
    one, other = case.calibrated(DRAWN), turned.calibrated(DRAWN)
    assert list(other.sensors) == list(one.sensors)[::-1]
    for name, each in one.sensors.items():
        assert other.sensors[name].gain == pytest.approx(each.gain, rel=1e-5)
    for name, light in one.lights.items():
        np.testing.assert_allclose(other.lights[name].position_mm, light.position_mm, atol=1e-4)


def test_derivatives_agree_with_finite_differences():
    rng = np.random.default_rng(0)
    lights = tuple(
        Light(position_mm=rng.normal([0, 0, 5], 1.0), direction=np.array([0.1, 0, -1]), lobe_exponent=m) for m in (1, 2)
    )
    count = 40
    places = rng.uniform(-1, 1, (count, 2))
    samples = Samples(
        camera=rng.integers(0, 3, count),
        starts=np.array([0, 15, count]),
        value=np.zeros(count),
        sigma=np.ones(count),
        dark=rng.random(count) < 0.5,
        terms=rng.uniform(0, 1, (count, 2)),
        basis=polynomials(places, 2),
        points=np.column_stack([places, np.zeros(count)]),
        normals=np.tile([0.0, 0, 1], (count, 1)),
        lit=((0,), (0, 1)),
    )
    precision = prior(3, [np.eye(4)] * 2, 1.0, 0.1)
    given, at = Given(gamma=np.array([2.2, 1.0, 1.8]), lights=lights, precision=precision), rng.normal(0, 0.05, 22)
    extra = rng.normal(0, 0.1, (2, 6))
    _, by, _ = _model(samples, given, at, extra)
    for column, step in enumerate(1e-6 * np.eye(len(at))):
        ahead, back = (_model(samples, given, at + sign * step, extra)[0] for sign in (1, -1))
        np.testing.assert_allclose(by[:, column], (ahead - back) / 2e-6, atol=1e-6)


def test_a_light_falls_off_with_the_square_of_its_distance():
    light = Light(position_mm=np.zeros(3), direction=np.array([0, 0, 1.0]), power=2.0)
    ahead, facing = np.array([[0, 0, 1.0], [0, 0, 3], [0, 0, -1]]), np.tile([0, 0, -1.0], (3, 1))
    np.testing.assert_allclose(light.irradiance(ahead, facing), [2, 2 / 9, 0])
    aside = np.array([[1.0, 0, 1]])
    np.testing.assert_allclose(light.irradiance(aside, facing[:1]), 2 * 0.5 * 0.5)  # Lambert twice, over 2 mm^2


@pytest.mark.parametrize("terraces", [1, 3])
def test_places_are_uniform_as_far_as_they_say(terraces):
    board = replace(BOARD, terraces=terraces, step_mm=0.2)
    places = clear_places(board)
    assert 0.3 < places.dark.mean() < 0.9
    for turn in np.linspace(0, 2 * np.pi, 9):
        beside = places.points + 0.97 * places.clearance_mm[:, None] * [np.cos(turn), np.sin(turn)]
        assert np.array_equal(board.is_dark(beside), places.dark)
        assert np.array_equal(board.terrace_at(beside[:, 0]), board.terrace_at(places.points[:, 0]))


# --- what is told ------------------------------------------------------------------------------------------------


def test_burnt_out_images_are_told():
    found = Rehearsal(rehearsal("evenly", 0).true, "evenly", exposure=1.6).calibrated()
    assert any("patches of paper are overexposed" in note for note in found.notes)
    dead = Rehearsal(replace(DRAWN, sensor=Sensor(noise_dn=0.0)), "evenly", exposure=100.0).calibrated(DRAWN)
    assert not dead.sensors
    assert dead.lights == DRAWN.lights
    assert sum("too few to determine" in note for note in dead.notes) == 4


def test_a_board_that_other_lights_lit_is_told():
    case = rehearsal("evenly", 0)
    found, plain = case.calibrated(DRAWN), case.calibrated()
    assert any("not lit by the drawn lights alone" in note for note in found.notes)
    assert all(light is DRAWN.lights[name] for name, light in found.lights.items())
    for name, each in plain.sensors.items():
        assert found.sensors[name].falloff == pytest.approx(each.falloff)
    assert any("light on the board is unknown" in note for note in plain.notes)


def test_gamma_is_told_only_where_lights_are_known():
    case = rehearsal("together", 0)
    assert any("gamma cannot be determined" in note for note in case.calibrated().notes)
    known = case.calibrated(DRAWN)
    assert not any("gamma cannot be determined" in note for note in known.notes)
    assert all(each.gamma_sigma_pct < 1 for each in known.cameras.values())
    held = case.calibrated(DRAWN, PhotometryOptions(gamma=2.0, gamma_pct=0.0))
    assert all(each.gamma == pytest.approx(2.0, rel=1e-3) for each in held.sensors.values())


# --- files and images --------------------------------------------------------------------------------------------


def test_without_gain_and_falloff_images_are_the_same_bits():
    light = np.random.default_rng(0).random((200, 200, 3))
    plain = expose(light, 1.0, DRAWN.sensor, np.random.default_rng(1))
    assert np.array_equal(record(light, 1.0, DRAWN, "o1", np.random.default_rng(1)), plain)
    dim = replace(DRAWN, sensors={"o1": Sensor(falloff=(-0.5, -0.1))})
    dimmed = record(light, 1.0, dim, "o1", np.random.default_rng(1)).astype(float)
    assert dimmed[100, 100].mean() == pytest.approx(plain[100, 100].mean(), abs=2)
    assert dimmed[:9, :9].mean() < 0.85 * plain[:9, :9].mean()
    assert sample_built(DRAWN, ManufacturingOptions()).sensors == {}


def test_sensors_and_covariances_are_written_only_where_they_are(tmp_path):
    storage.write_handpiece(tmp_path / "plain.json", DRAWN)
    plain = storage.read_json(tmp_path / "plain.json")
    assert "sensors" not in plain
    assert set(plain["sensor"]) == {"noise_dn", "shot_noise_share", "gamma"}
    assert not any("covariance" in key for light in plain["lights"].values() for key in light)
    sensor = Sensor(gain=1.2, falloff=(-0.3, 0.1), covariance=np.diag([1e-4, 1e-3, 1e-3, 1e-2]))
    lights = {name: replace(light, covariance=1e-4 * np.eye(4)) for name, light in DRAWN.lights.items()}
    storage.write_handpiece(tmp_path / "full.json", replace(DRAWN, sensors={"o2": sensor}, lights=lights))
    again = storage.read_handpiece(tmp_path / "full.json")
    assert again.sensor_of("o2").falloff == sensor.falloff
    assert again.sensor_of("o2").gain == 1.2
    assert again.sensor_of("o1").gain == 1.0
    np.testing.assert_allclose(again.sensor_of("o2").covariance, sensor.covariance)
    np.testing.assert_allclose(again.lights["o1"].covariance, 1e-4 * np.eye(4))
    with pytest.raises(InputError, match="unknown cameras x"):
        replace(DRAWN, sensors={"x": sensor})
    broken = storage.read_json(tmp_path / "full.json")
    broken["sensors"]["o2"]["falloff_r2_r4"] = [1e9, 0]
    storage.write_json(tmp_path / "broken.json", broken)
    with pytest.raises(InputError, match="sensor 'o2': falloff_r2_r4"):
        storage.read_handpiece(tmp_path / "broken.json")


@pytest.mark.long
def test_a_calibration_with_lights_is_rehearsed(tmp_path, capsys):
    """From images to files, with the geometry found, too."""
    drawn = tmp_path / "drawn.json"
    storage.write_handpiece(drawn, DRAWN)
    how = PhotographOptions(instants=12, supersampling=1, lit="one-by-one")
    take_photographs(sample_built(DRAWN, replace(BUILT, manufacturing_um=10.0)), BOARD, tmp_path / "photos", how)
    images = tmp_path / "photos" / "images"
    run("calibrate", images, "--drawn", drawn, "--out", tmp_path / "rig", *board_options(BOARD))
    true = storage.read_handpiece(tmp_path / "photos" / "truth" / "handpiece.json")
    found = storage.read_handpiece(tmp_path / "rig" / "handpiece.json")
    told = storage.read_json(tmp_path / "rig" / "calibration.json")["photometry"]
    assert found.lightings[0].lights == DRAWN.lightings[0].lights
    assert all(each["held_out_pct"] < 0.3 * each["before_pct"] for each in told["cameras"].values())
    to_true = in_frame_of(located(found, {}), true.rig).rig["o1"].cam_from_rig.inverse() @ found.rig["o1"].cam_from_rig
    for name, light in found.lights.items():
        off = to_true.apply(light.position_mm) - true.lights[name].position_mm
        assert np.linalg.norm(off) < 0.06
        assert np.linalg.norm(told["lights"][name]["position_sigma_um"]) < 50
    for name, sensor in found.sensors.items():
        assert abs(sensor.corner_loss - true.sensor_of(name).corner_loss) < 0.05
    assert (tmp_path / "rig" / "photometry.png").stat().st_size > 20_000
    assert "Light" in capsys.readouterr().err
    other = tmp_path / "other.json"
    storage.write_handpiece(other, replace(DRAWN, rig=type(DRAWN.rig)({"x": DRAWN.rig["o1"]})))
    message = refused(capsys, "calibrate", images, "--drawn", other, "--out", tmp_path / "no", *board_options(BOARD))
    assert "give them the same names" in message
