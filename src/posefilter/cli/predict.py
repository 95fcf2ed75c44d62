"""Find the object, or several, in one photograph: poses, a picture, and beliefs."""

import math
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, ListConfig

from posefilter.cli.checkpoints import check_once, method_of, methods_of, read_checkpoint
from posefilter.cli.components import changes
from posefilter.cli.console import JSON, ended, say
from posefilter.cli.job import Job
from posefilter.cli.machine import settle
from posefilter.cli.plain import key_of
from posefilter.cli.preflight import parse_intrinsics
from posefilter.cli.results import write_json
from posefilter.cli.shapes import load_shape, open_shapes
from posefilter.confidence.tolerance import PoseTolerance, read_pose_tolerance
from posefilter.confidence.verdicts import Costs, describe_probability
from posefilter.data.camera_files import CameraFile, read_camera_file
from posefilter.data.readers.decode import expect_size, holds_meters, read_color, read_depth
from posefilter.errors import NotThere, UserError
from posefilter.estimator import Estimator
from posefilter.figures.canvas import save_image
from posefilter.figures.detections import Drawn, draw_detections
from posefilter.figures.overlay import Shape
from posefilter.figures.recording import record
from posefilter.figures.view_data import collect_view_data
from posefilter.geometry.camera import find_matrix_flaw
from posefilter.geometry.lens import read_distortion, undistort_most
from posefilter.images import check_images, drop_unknown
from posefilter.limits import read_json
from posefilter.meshes.ycb import number_objects
from posefilter.metrics.bop_results import PoseRow, choose_score, write_poses_csv
from posefilter.result import Result, collect_results
from posefilter.weights import expand_weights, is_several

VIEW = "view.rrd"
# what an answer consists of, but for the overlay, which each writes anew; the first is a mark of it
_ALONE = ("pose.json", "belief.png", "belief.npz", "band.png", VIEW)
_SEVERAL = ("poses.json", "poses.csv", "beliefs/[0-9]*_*.npz")
_FRAME = (
    "OpenCV camera (x right, y down, z ahead), the object as in its mesh file; camera_from_object "
    "in meters"
)
_PROBABILITY = (
    "that the object is in the image and the pose within 0.1 diameters (ADD), calibrated on "
    "validation scenes of which half showed the object; presence: that it is in the image"
)
# what an answer tells, null where there is nothing to say
_TOLD = (
    "object", "instance", "verdict", "probability", "presence", "probability_is", "pose_tolerance",
    "probability_within", "costs", "camera_from_object", "rotation", "translation_mm", "score",
    "score_is", "warnings", "scale_ratio", "belief", "belief_file", "visible_pixels", "seconds",
    "frame", "checkpoint", "rgb", "depth",
)  # fmt: skip
_SURFACE = PoseTolerance(add_s=0.1)
_CALIBRATED = (
    "where the pose is if the estimate is right (within 0.1 diameters), as wide as the errors of "
    "right estimates on validation scenes are"
)
_AS_FILTERED = "the particles as the filter leaves them, which are not calibrated"
_COVARIANCE = (
    "about the mean pose: x, y, z of the object's center in the camera's axes [m], then the "
    "rotation vector about it in the object's own axes [rad]"
)
_ERROR_COVARIANCE = "of the pose's error, if the pose is right; axes and units as of covariance"
_USUAL_UNITS = 100, 100_000  # of depth files, in a meter


def predict(job: Job) -> None:
    """Find one object; or where several checkpoints are given, or instances, all that there are.

    Raises:
        NotThere: Everything is written, and the verdict on every object is that it is absent.
    """
    settle(job.cfg.threads, job.cfg.seed)
    several = is_several(job.cfg.checkpoint) or job.cfg.instances is not None
    results = predict_several(job) if several else predict_one(job)
    if not job.swept and all(one.verdict == "absent" for one in results):
        raise NotThere("; ".join(one.describe() for one in results) or "nothing is found")


def predict_one(job: Job) -> list[Result]:
    """Write pose.json, overlay.png, belief.png, belief.npz, band.png of an object that is there,
    and where asked for view.rrd.
    """
    cfg, folder = job.cfg, job.folder
    costs, tolerance = read_costs(cfg), read_pose_tolerance(cfg.pose_tolerance)
    method = method_of(read_checkpoint(cfg.checkpoint), changes(cfg), lightning=False)
    estimator = Estimator([method], pose_tolerance=tolerance)
    rgb, depth, K = read_inputs(job)
    shape = load_shape(open_shapes(cfg, [method.object_model.name]), method.object_model)
    images, _ = check_images(rgb, depth, K)
    (run,) = estimator.run(images, cfg.seed)
    ((result,),) = collect_results([run], costs, tolerance)
    folder.mkdir(parents=True, exist_ok=True)
    replace_answers(job)
    save_image(result.draw_overlay(rgb, K, shape), folder / "overlay.png")
    band = folder / "band.png"
    if result.verdict != "absent":
        save_image(result.draw_band(rgb, K, shape), band)
    save_image(result.draw_belief(rgb, K), folder / "belief.png")
    belief_file = folder / "belief.npz"
    result.belief.save(belief_file)
    answer = describe(result, method.filter.score_is, cfg.checkpoint, belief_file, job)
    write_json(folder / "pose.json", answer)
    if cfg.save_rerun:
        model, space = method.object_model, method.space
        draws = None if run.draws is None else int(run.draws[0])
        view = collect_view_data(run.trace, run.batch, model, space, shape, draws=draws)
        record(view, folder / VIEW)
    if cfg.console != JSON:
        print_result(result)
    files = {"pose": folder / "pose.json", "overlay": folder / "overlay.png"}
    files |= {"belief": folder / "belief.png", "numbers": belief_file}
    files |= {"band": band} if result.verdict != "absent" else {}
    files |= {"view": folder / VIEW} if cfg.save_rerun else {}
    following = [f"rerun {shlex.quote(str(folder / VIEW))}"] if cfg.save_rerun else []
    ended(cfg.console, "predicted", files, following, **answer)
    return [result]


def predict_several(job: Job) -> list[Result]:
    """Write poses.json, a list with an entry an object, or with `instances` one for each that is
    found; one overlay of those that are not absent; poses.csv, and each one's belief.
    """
    cfg, folder = job.cfg, job.folder
    if (folder / "poses.csv").is_file() and not (folder / "poses.json").is_file():
        raise UserError(f"out={folder}: its poses.csv is of another command; choose another folder")
    costs, tolerance = read_costs(cfg), read_pose_tolerance(cfg.pose_tolerance)
    methods = methods_of(cfg.checkpoint, changes(cfg))
    estimator = Estimator(methods, costs=costs, pose_tolerance=tolerance)
    if cfg.instances is not None:
        check_once(estimator.objects)
    rgb, depth, K = read_inputs(job)
    store = open_shapes(cfg, estimator.objects)
    if cfg.instances is None:
        (results,) = estimator.predict_batch(rgb[None], depth[None], K, seed=cfg.seed)
    else:
        results = estimator.predict(rgb, depth, K, instances=cfg.instances, seed=cfg.seed)
    seen = [one for one in results if one.verdict != "absent"]
    absent = [name for name in estimator.objects if name not in {one.object for one in seen}]
    drawn = [mark_result(one, load_shape(store, one.object_model)) for one in seen]
    replace_answers(job)
    beliefs = folder / "beliefs"
    beliefs.mkdir(parents=True, exist_ok=True)
    save_image(draw_detections(rgb, K, drawn, absent), folder / "overlay.png")
    checkpoints = expand_weights(cfg.checkpoint)
    own = dict(zip(estimator.objects, checkpoints, strict=True))
    scores = {one.object_model.name: one.filter.score_is for one in estimator.methods}
    answers = []
    for number, result in enumerate(results):
        file = beliefs / f"{number:02d}_{result.object}.npz"
        result.belief.save(file)
        name = result.object
        # one answer each; of several instances, an object's only checkpoint
        checkpoint = checkpoints[number] if cfg.instances is None else own[name]
        answers.append(describe(result, scores[name], checkpoint, file, job))
        if cfg.console != JSON:
            print_result(result)
    missing = [name for name in absent if name not in {one.object for one in results}]
    answers += [describe_absent(one, scores[one], costs, own[one], job) for one in missing]
    write_json(folder / "poses.json", answers)
    # with instances= that of classes without a result is not known
    seconds = sum(one.seconds for one in results)
    write_poses_csv(folder / "poses.csv", list_rows(seen, estimator.objects, seconds))
    files = {"poses": folder / "poses.json", "poses.csv": folder / "poses.csv"}
    files |= {"overlay": folder / "overlay.png", "beliefs": beliefs}
    ended(cfg.console, "predicted", files, [], poses=answers)
    return results


def replace_answers(job: Job) -> None:
    """Remove the files of an earlier answer, with a line where it was on another photograph."""
    earlier, folder = find_photograph(job.folder), job.folder
    remove_answers(folder)
    if earlier not in ("", str(job.cfg.rgb)):
        line = f"{folder}: the answer on {earlier} is replaced; out=DIR would keep both"
        say(job.cfg.console, "replaced", line, folder=str(folder), rgb=earlier)


def find_photograph(folder: Path) -> str:
    """Return the photograph that a folder's answer is on, "" where there is none."""
    for mark, *_ in (_ALONE, _SEVERAL):
        with suppress(UserError):  # it is missing, or none of ours
            content = read_json(folder / mark)
            first = content[0] if isinstance(content, list) and content else content
            if isinstance(first, dict) and isinstance(first.get("rgb"), str):
                return str(first["rgb"])
    return ""


def remove_answers(folder: Path) -> None:
    """Remove the files of an earlier answer: those that a new one lacks would pass for its own."""
    for mark, *others in (_ALONE, _SEVERAL):
        if (folder / mark).is_file():  # files of these names alone may be another command's
            for file in [one for name in (*others, mark) for one in folder.glob(name)]:
                file.unlink()
    with suppress(OSError):  # is not there, or not empty
        (folder / "beliefs").rmdir()


def list_rows(results: Sequence[Result], objects: Sequence[str], seconds: float) -> list[PoseRow]:
    """Return results as lines of a BOP results file: of scene 0 and image 0, in the frame of the
    mesh files, and with the objects' numbers of `number_objects`.

    seconds: That the image took; the challenge's time is that of an image.
    """
    rows, numbers = [], number_objects(objects)
    for one in results:
        number = numbers[one.object]
        score = choose_score(one.probability, one.score)
        rows.append(PoseRow(0, 0, number, score, one.pose, seconds))
    return rows


def read_costs(cfg: DictConfig) -> Costs:
    """Return what errors cost, as typed."""
    return Costs(cfg.cost_false_alarm, cfg.cost_miss, cfg.cost_unsure)


def mark_result(result: Result, shape: Shape) -> Drawn:
    """Return how a result is drawn among several: its line, its tag, its name in the legend."""
    unsure = result.verdict == "unsure"
    if result.probability is None or result.presence is None:
        said, tag = f"score {result.score:.1f}", ""
    else:
        # by the tolerance that the verdict goes by
        said = describe_probability(result.probability_within(result.pose_tolerance))
        tag = f"{result.object} {said}"
        if unsure:
            said = f"unsure {said}, there {describe_probability(result.presence)}"
    known = f"{said}, implausible" if result.warnings else said
    return Drawn(f"{result.object} ({known})", result.pose, shape, tag, unsure)


def print_result(result: Result) -> None:
    """Print whether and where the object is, and what speaks against it."""
    place = np.array2string(
        1000 * result.pose[:3, 3], precision=1, floatmode="fixed", suppress_small=True
    )
    absent = result.verdict == "absent"
    if result.verdict is None:
        print(f"{result.object} at {place} mm, {result.seconds:.2f} s")
        print(f"no probability: {result.calibration_note}")
    else:
        at = "" if absent else f", at {place} mm"
        print(f"{result.describe()}{at}, {result.seconds:.2f} s")
    if is_found_by_surface(result):
        within = describe_probability(result.probability_within(_SURFACE))
        said = f"probability {within} {_SURFACE.describe()}"
        how = f"pose_tolerance.add_s={_SURFACE.add_s}"
        print(f"{said}: its place is surer than its rotation ({how})")
    if not absent:
        said = "if it is right" if result.belief_calibrated else "the particles"
        print(f"{said}: {result.belief.uncertainty().describe()}")
    # the pose of an object that is absent says nothing about the camera
    for warning in result.input_warnings if absent else result.warnings:
        print(f"warning: {warning}")


def is_found_by_surface(result: Result) -> bool:
    """Tell whether an unsure object would be found if ADD-S were all that counts."""
    known = result.calibration is not None and result.calibration.errors is not None
    asked = result.verdict == "unsure" and result.pose_tolerance is None
    return asked and known and result.decide(result.costs, _SURFACE) == "found"


def describe_uncertainty(result: Result) -> dict[str, Any]:
    """Return how far the truth may be, in numbers and words."""
    sure = result.belief.uncertainty()
    translation, rotation = 1000 * sure.translation, math.degrees(sure.rotation)
    return {
        "in_words": sure.describe(),
        "level": sure.level,
        "translation_mm": translation,
        "rotation_deg": rotation,
        "shift_mm": translation,  # the two by their earlier names
        "turn_degrees": rotation,
        "of_mode_with_mass": sure.mass,
    }


def describe(
    result: Result, score_is: str, checkpoint: str | Path, belief_file: Path, job: Job
) -> dict[str, Any]:
    """Return pose.json, or an entry of poses.json."""
    pose, absent = result.pose, result.verdict == "absent"
    return {
        **describe_absent(result.object, score_is, result.costs, checkpoint, job),
        "instance": result.instance,
        "verdict": result.verdict,
        "probability": result.probability,
        "presence": result.presence,
        "probability_is": result.calibration_note or _PROBABILITY,
        **describe_tolerance(result),
        "camera_from_object": None if absent else pose.tolist(),
        "rotation": None if absent else pose[:3, :3].tolist(),
        "translation_mm": None if absent else (1000 * pose[:3, 3]).tolist(),
        "score": result.score,
        "warnings": list(result.warnings),
        "scale_ratio": None if math.isnan(result.scale_ratio) else result.scale_ratio,
        "belief": describe_belief(result),
        "belief_file": str(belief_file),
        "visible_pixels": None if result.mask is None else int(result.mask.sum()),
        "seconds": result.seconds,
    }


def describe_tolerance(result: Result) -> dict[str, Any]:
    """Return the probability that the verdict goes by where a tolerance is given; else nothing."""
    tolerance = result.pose_tolerance
    if tolerance is None:
        return {}
    known = result.probability is not None
    within = result.probability_within(tolerance) if known else None
    return {"pose_tolerance": asdict(tolerance), "probability_within": within}


def describe_belief(result: Result) -> dict[str, Any]:
    """Return what the particles come to."""
    belief = result.belief
    return {
        "belief_is": _CALIBRATED if result.belief_calibrated else _AS_FILTERED,
        "particles": len(belief.weights),
        "effective_particles": belief.effective_samples,
        "weight_entropy": belief.weight_entropy,
        "differential_entropy": belief.differential_entropy,
        "entropy": belief.weight_entropy,  # by its earlier name
        "mean": belief.mean.tolist(),
        "covariance": belief.covariance.tolist(),
        "covariance_is": _COVARIANCE,
        "error_covariance": result.covariance.tolist(),
        "error_covariance_is": _ERROR_COVARIANCE,
        "uncertainty": describe_uncertainty(result),
        "modes": [
            {
                "camera_from_object": mode.pose.tolist(),
                "mass": mode.mass,
                "equivalent_to": mode.equivalent,
            }
            for mode in belief.modes
        ],
    }


def describe_absent(
    name: str, score_is: str, costs: Costs, checkpoint: str | Path, job: Job
) -> dict[str, Any]:
    """Return what is written of an object that is not found."""
    return dict.fromkeys(_TOLD) | {
        "object": name,
        "verdict": "absent",
        "probability_is": _PROBABILITY,
        "costs": asdict(costs),
        "score_is": score_is,
        "warnings": [],
        "frame": _FRAME,
        "checkpoint": str(checkpoint),
        "rgb": str(job.cfg.rgb),
        "depth": str(job.cfg.depth),
    }


def read_inputs(job: Job) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return color (H, W, 3) uint8, depth (H, W) [m] and K (3, 3) [px], of the rectified image.

    Raises UserError where one is missing or they do not fit each other.
    """
    cfg = job.cfg
    rgb, depth = read_photograph(cfg.rgb, cfg.depth, cfg.depth_scale)
    camera = read_intrinsics(cfg.intrinsics, cfg.distortion is not None)
    by_default = "depth_scale" not in map(key_of, job.overrides)
    # last, since it reads the file once more
    if by_default and camera.depth_scales and not holds_meters(Path(cfg.depth)):
        check_depth_scale(camera, cfg.depth_scale, f"intrinsics={cfg.intrinsics}")
    K = camera.K
    if camera.size is not None:
        expect_size(Path(cfg.rgb), rgb, *camera.size, f"intrinsics={cfg.intrinsics}")
    if cfg.distortion is not None:
        rgb, depth = undistort_most(rgb, depth, K, parse_distortion(cfg.distortion))
    return rgb, depth, K


def check_depth_scale(camera: CameraFile, units: float, setting: str) -> None:
    """Raise UserError where the camera's file has another depth scale than the default, or several.

    Args:
        camera: The camera.
        units: Units of the depth files in a meter, which nobody typed.
        setting: What names the file, as typed.
    """
    if not camera.depth_scales:
        return
    own, *others = camera.depth_scales
    if others:  # which only BOP's files have
        some = ", ".join(f"{one:g}" for one in camera.depth_scales[:6])
        raise UserError(
            f"{setting}: its images have different depth scales ({some}); type depth_scale=, 1000 "
            "over that of this image"
        )
    readings = {
        "millimeters a unit (BOP's files)": 1000 / own,
        "meters a unit": 1 / own,
        "units in a meter": own,
    }
    if any(math.isclose(units, one, rel_tol=1e-3) for one in readings.values()):
        return
    low, high = _USUAL_UNITS
    meant = ", or ".join(
        f"in {unit} means depth_scale={one:g} here"
        for unit, one in readings.items()
        if low <= one <= high
    )
    which = f"which {meant}, and " if meant else "and "
    raise UserError(
        f"{setting}: its depth_scale is {own:g}, {which}{units:g} is the default; type depth_scale="
    )


def parse_distortion(numbers: Any) -> tuple[float, ...]:
    """Return the coefficients that were typed.  Raises UserError where they are none."""
    parts = list(numbers) if isinstance(numbers, ListConfig | list) else str(numbers).split(",")
    return read_distortion(parts)


def read_photograph(rgb: str, depth: str, depth_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Read color (H, W, 3) uint8 and depth (H, W) [m].

    Raises UserError where they do not fit each other.
    """
    color, z = read_color(Path(rgb)), drop_unknown(read_depth(Path(depth), depth_scale))
    if color.shape[:2] != z.shape:
        raise UserError(
            f"depth={depth}: {z.shape[1]}x{z.shape[0]} pixels, but the color image has "
            f"{color.shape[1]}x{color.shape[0]}"
        )
    if not (z > 0).any():
        raise UserError(f"depth={depth}: no pixel has depth")
    median = float(np.median(z[z > 0]))
    if not 0.05 <= median <= 30:
        if holds_meters(Path(depth)):
            raise UserError(
                f"depth={depth}: its floats should be meters, which depth_scale does not change, "
                f"and their median is {median:.3g}"
            )
        raise UserError(
            f"depth_scale={depth_scale}: the median depth would be {median:.3g} m; is it 1000 or "
            "10000?"
        )
    return color, z


def read_intrinsics(typed: Any, distorted: bool = False) -> CameraFile:
    """Return a camera: of fx, fy, cx, cy [px], of a matrix's nine numbers, or of a file.

    Args:
        typed: The setting.
        distorted: Whether the distortion of the lens is typed beside it.

    Raises:
        UserError: It is none of these; or the file tells a distortion, and none is typed: it does
            not tell whether the images are rectified.
    """
    values = parse_intrinsics(typed)
    if isinstance(values, Path):
        return _read_camera(values, distorted)
    if len(values) == 4:
        fx, fy, cx, cy = values
        values = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    K = np.array(values).reshape(3, 3)
    if flaw := find_matrix_flaw(K):
        raise UserError(f"intrinsics={typed}: are no camera's ({flaw})")
    return CameraFile(K)


def _read_camera(path: Path, distorted: bool) -> CameraFile:
    """Return a file's camera.  Raises UserError where it must be said whether images are raw."""
    camera = read_camera_file(path)
    if not camera.distortion or (distorted and not camera.other_model):
        return camera
    raw = f"of raw ones intrinsics={_list_numbers(camera.K)} distortion=" + ",".join(
        f"{one:g}" for one in camera.distortion
    )
    kind = "distortion"
    if camera.other_model:
        kind = f"distortion ({camera.other_model})"
        raw = "raw ones rectify before: distortion= is OpenCV's k1,k2,p1,p2,k3 and no other"
    better = camera.K if camera.rectified is None else camera.rectified
    raise UserError(
        f"intrinsics={path}: tells a {kind} of the lens; of rectified images type "
        f"intrinsics={_list_numbers(better)}, {raw}"
    )


def _list_numbers(K: np.ndarray) -> str:
    return ",".join(f"{one:.8g}" for one in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
