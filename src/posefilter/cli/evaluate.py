"""Test a checkpoint, or poses of any other method, on a dataset."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import Callback, Trainer
from omegaconf import DictConfig, OmegaConf

from posefilter.callbacks.errors import ErrorTable, make_rows
from posefilter.callbacks.records import Records, to_rows, write_beliefs
from posefilter.cli.bop_scores import assign_estimates, score_targets
from posefilter.cli.build import build_data, check_share, make_trainer, quiet
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.components import changed, changes, chosen
from posefilter.cli.console import typed, warn
from posefilter.cli.folders import keep_training_results, read_results
from posefilter.cli.job import Job
from posefilter.cli.learned import warn_of_learned
from posefilter.cli.machine import settle
from posefilter.cli.plain import key_of, to_plain
from posefilter.cli.progress_bar import progress
from posefilter.cli.recipe import check_data, no_own_folder
from posefilter.cli.results import record, show, write_json
from posefilter.confidence.tolerance import RIGHT, read_pose_tolerance
from posefilter.data.absent import hide_annotation
from posefilter.data.dataset import FrameDataset
from posefilter.data.loaders import make_loader
from posefilter.data.module import PoseDataModule
from posefilter.errors import UserError
from posefilter.geometry.boxes import box_of_pose
from posefilter.metrics.bop import BopErrors
from posefilter.metrics.bop_results import (
    measure_seconds,
    read_poses_csv,
    to_mesh,
    write_poses_csv,
)
from posefilter.metrics.bop_targets import Target, read_targets
from posefilter.metrics.collect import BoxIoU, ErrorsByVisibility, PoseErrors
from posefilter.metrics.errors import add
from posefilter.metrics.image_errors import FILE as ERRORS
from posefilter.metrics.image_errors import ImageError, write_errors
from posefilter.metrics.results import compute_checkpoint_score
from posefilter.metrics.scale_ratio import describe_mismatch
from posefilter.models.base import PoseEstimator
from posefilter.models.evaluation import judge_confidence
from posefilter.paths import check_links, find_conf
from posefilter.types import Batch, ObjectModel

ALL = "all"  # targets: every instance that is visible enough
OF_THE_CHECKPOINT = ("object", "image_width", "image_height", "batch_size_test")
_BATCH = 8  # images without the object
_SAME_OBJECT = 0.003  # [m] by which the center and radius of two meshes of one object may differ


def evaluate(job: Job) -> float:
    """Write metrics.json, and for a checkpoint poses.csv and beliefs.npz.

    Returns the score that sweeps compare.
    """
    quiet()
    settle(job.cfg.threads, job.cfg.seed)
    if bool(job.cfg.checkpoint) == bool(job.cfg.estimates):
        raise UserError("give either checkpoint=RUN/checkpoints/best.ckpt or estimates=poses.csv")
    if job.cfg.targets is not None and not job.cfg.estimates:
        raise UserError("targets: go with estimates=poses.csv, not with a checkpoint")
    if job.cfg.estimates and read_pose_tolerance(job.cfg.pose_tolerance) is not None:
        raise UserError("pose_tolerance: is of a checkpoint's probability; estimates have none")
    check_links(job.folder)  # of a run of somebody else, before anything in it is written
    read_results(job)  # refused where they are of another
    keep_training_results(job.folder)
    metrics, files = _of_estimates(job) if job.cfg.estimates else _of_checkpoint(job)
    write_json(job.folder / "metrics.json", {**metrics, "command": "evaluate"})
    files = {"metrics": job.folder / "metrics.json", **files}
    size = metrics.get("scale_ratio") or {}
    mismatch = describe_mismatch(size, metrics["data"]["root"])
    if mismatch:
        warn(job.cfg.console, mismatch, **size)
    reported = (job.folder / ".hydra").is_dir() and not job.swept
    following = [typed("report", run=job.folder)] if reported else []
    tested = str(job.cfg.estimates or job.cfg.checkpoint)
    show(metrics, tested, job.cfg.console, "evaluated", files, following)
    return compute_checkpoint_score(metrics)


def _of_checkpoint(job: Job) -> tuple[dict[str, Any], dict[str, Path]]:
    checkpoint = read_checkpoint(job.cfg.checkpoint)
    method = method_of(checkpoint, changes(job.cfg))
    method.seed = job.cfg.seed
    tolerance = read_pose_tolerance(job.cfg.pose_tolerance)
    if tolerance is not None and method.calibration is None:
        raise UserError(
            f"pose_tolerance: checkpoint={job.cfg.checkpoint} has no probability to be within one: "
            f"{method.calibration_note}"
        )
    method.pose_tolerance = tolerance or RIGHT
    if method.calibration is not None:
        method.calibration.fit_success(method.pose_tolerance)  # refused before anything is tested
    settings = data_settings(job, checkpoint["recipe"]["settings"], method.object_model.name)
    check_own_folders(settings, job)
    data = build_data(settings, job.cfg.console, job.overrides)
    data.setup("test")
    judge_by(method, object_to_judge(data, method.object_model))
    if method.calibration is None and checkpoint.get("calibration") is not None:
        warn(job.cfg.console, f"no probabilities: {method.calibration_note}")
    warn_of_several(data, job.cfg.console)
    warn_of_learned(str(job.cfg.checkpoint), data, job.cfg.console)
    records = Records()
    callbacks = [records, ErrorTable(job.folder), progress(job.cfg.console)]
    trainer = make_tester(job.cfg.trainer, callbacks)
    if trainer.limit_test_batches == 0:
        raise UserError("trainer.limit_test_batches=0: leaves nothing to test")
    check_share(trainer, data, "test")
    device = trainer.strategy.root_device
    # broken files are refused before anything is tested
    absent = open_absent(method, data, job.cfg.absent_frames, job.cfg.console)
    trainer.test(method, datamodule=data, verbose=False)
    method.to(device)  # which Lightning has left
    files = {"beliefs": job.folder / "beliefs.npz", "errors": job.folder / ERRORS}
    if absent is not None:
        judge_absent(method, absent)
    tested = replace(job, choices={**checkpoint["recipe"]["choices"], **chosen(job)})
    source = Path(job.cfg.checkpoint)
    found = record(method.collect_results(), tested, data.describe(), source, device)
    native = data.reader.native_from_mesh
    if "pose" in method.capabilities:
        files["poses"] = job.folder / "poses.csv"
        write_poses_csv(files["poses"], to_rows(records.outcomes, data.records("test"), native))
    write_beliefs(files["beliefs"], records.outcomes, data.records("test"), native)
    return found, files


def make_tester(node: DictConfig, callbacks: list[Callback]) -> Trainer:
    """Build a trainer that tests in this process.

    Raises:
        UserError: It would start others, as for each device that `auto` finds.
    """
    trainer = make_trainer(node, callbacks)
    if trainer.world_size > 1:
        raise UserError(
            f"trainer.devices={node.get('devices')}: evaluate tests in one process, and this would "
            f"be {trainer.world_size}; leave it at 1"
        )
    return trainer


def warn_of_several(data: PoseDataModule, console: str) -> None:
    """Say where images show several instances of the object: a method gives one pose an image."""
    counts = Counter((r.scene_id, r.im_id, r.obj_id) for r in data.records("test"))
    several = sum(count > 1 for count in counts.values())
    if several:
        sentence = (
            f"{several} of {len(counts)} images show several instances of the object; the "
            "one pose of an image is compared with each of them, so that most count as wrong "
            "(predict.py instances=N finds several)"
        )
        warn(console, sentence, several=several, images=len(counts))


def open_absent(
    method: PoseEstimator, data: PoseDataModule, limit: int, console: str
) -> FrameDataset | None:
    """Return frames of the test's scenes that lack the object, None where none are wanted or there.

    Args:
        method: Only a calibrated one is judged by them.
        data: The frames' dataset.
        limit: How many frames at most.
        console: "rich" or "json".
    """
    if method.calibration is None or limit == 0:
        return None
    frames = data.absent_dataset("test", limit)
    if len(frames):
        return frames
    sentence = (
        f"no frame of the test's scenes is known to lack {method.object_model.name}: false "
        "alarms are not counted"
    )
    warn(console, sentence)
    return None


def judge_absent(method: PoseEstimator, frames: FrameDataset) -> None:
    """Add frames that lack the object to the metrics of a method that was tested on others."""
    with torch.no_grad():
        for number, batch in enumerate(make_loader(frames, frames.find_batch_size(_BATCH), 0)):
            hidden = Batch(*(x.to(method.device) for x in hide_annotation(batch)))
            trace = method.predict_step(hidden, number)
            judge_confidence(method, trace, hidden, present=False)


def _of_estimates(job: Job) -> tuple[dict[str, Any], dict[str, Path]]:
    """Score a BOP results file: of each instance that is there, the estimate that is matched to it;
    of a class that an image shows once, its most confident estimate.
    """
    if not job.cfg.get("data"):
        raise UserError(
            "estimates need to know of which data: give data=fat|ycb_video|bop|scenes "
            "and data.root=DIR"
        )
    rows = read_poses_csv(Path(str(job.cfg.estimates)))
    settings = data_settings(job, {}, None)
    targets = list_targets(job, settings)
    data = build_data(settings, job.cfg.console, job.overrides)
    data.setup("test")
    assigned = assign_estimates(rows, data.records("test"), data)
    if not assigned:
        raise UserError(
            f"estimates={job.cfg.estimates}: none of its {len(rows)} rows belongs to "
            f"an instance of this data"
        )
    models = [data.object_model(i) for i in range(len(data.objects))]
    errors, bop, iou = PoseErrors(models), BopErrors(models), BoxIoU()
    by_visibility = ErrorsByVisibility(models)
    in_mesh_frame = list[float]()  # ADD [m], were they of the meshes' frames
    table = list[ImageError]()
    for batch in data.test_dataloader():
        own = [data.records("test")[i] for i in batch.frame_id.tolist()]
        estimates = [assigned.get(r.key) for r in own]
        poses = torch.full_like(batch.camera_from_object, torch.nan)
        for i, estimate in enumerate(estimates):
            if estimate is None:
                in_mesh_frame.append(inf)
                continue
            native = data.reader.native_from_mesh(own[i].object)
            pose = to_mesh(estimate.camera_from_native, native)
            poses[i] = torch.from_numpy(pose.astype(np.float32))
            as_it_is = torch.from_numpy(estimate.camera_from_native)[None]
            truth = batch.camera_from_object[i : i + 1].double()
            points = models[int(batch.object_id[i])].points.double()
            in_mesh_frame += add(as_it_is, truth, points).tolist()
        errors.update(poses, batch.camera_from_object, batch.object_id)
        by_visibility.update(errors.last(), batch.visibility)
        height, width = batch.rgb.shape[-2:]
        bop.update(poses, batch.camera_from_object, batch.intrinsics, width, batch.object_id)
        scores = [nan if row is None else row.score for row in estimates]
        times = [nan if row is None or row.seconds < 0 else row.seconds for row in estimates]
        no_particles = [nan] * len(own)
        table += make_rows(
            own,
            batch,
            errors.last(),
            particles_on_object=no_particles,
            score=scores,
            seconds=times,
        )
        for i, index in enumerate(batch.object_id.tolist()):
            hull, K = errors.models[index].hull, batch.intrinsics[i : i + 1]
            truth = box_of_pose(batch.camera_from_object[i : i + 1], hull, K, height, width)
            guess = box_of_pose(poses[i : i + 1], hull, K, height, width).nan_to_num(0.0)
            iou.update(guess, truth)
    found = errors.compute()
    other = 1000 * float(np.median(in_mesh_frame))
    warn_of_frame(found["add"]["median_mm"], other, job.cfg.console)
    tested = {(r.scene_id, r.im_id, r.obj_id) for r in data.records("test")}
    seconds, mixed = measure_seconds([row for row in rows if row[:3] in tested])
    if mixed:
        sentence = (
            f"the rows of an image differ in their time in {mixed} images; BOP's time is that of "
            "the whole image, and its toolkit refuses others (docs/instances.md adds them up)"
        )
        warn(job.cfg.console, sentence, images=mixed)
    results = found | bop.compute()
    results |= {"iou": float(iou.compute()), "particles_on_object": None}
    results["seconds_per_image"] = seconds
    results |= {"belief": None, "by_visibility": by_visibility.compute()}
    if job.cfg.targets is not None:
        results["bop"] = score_targets(rows, targets, data.records("test"), data)
        if count := results["bop"]["left_out"]:
            sentence = (
                f"{count} of the targets are in images that cannot be read: the recall is of the "
                "others, and does not compare with the challenge's"
            )
            warn(job.cfg.console, sentence, left_out=count)
    write_errors(job.folder / ERRORS, table)
    metrics = {**record(results, job, data.describe(), None), "estimates": str(job.cfg.estimates)}
    return metrics, {"errors": job.folder / ERRORS}


def list_targets(job: Job, settings: DictConfig) -> list[Target] | None:
    """Return what is to be found, None for all that is visible enough; unless typed otherwise, the
    settings of the data then are those of the targets: their objects, and of a file their images.

    Raises:
        UserError: The file of targets is missing or broken.
    """
    if job.cfg.targets is None:
        return None
    if not any("data.object=" in one for one in job.overrides):
        default = OmegaConf.load(find_conf() / "data" / "_base.yaml").object
        if settings.object == default:
            settings.object = None  # the targets say which objects are meant
    if str(job.cfg.targets) == ALL:
        return None
    path, targets = read_targets(str(job.cfg.targets), Path(str(settings.root)))
    if not any(_is_of_split(key_of(one).removeprefix("data.")) for one in job.overrides):
        settings.split = {"test": str(path)}
    return targets


def warn_of_frame(own: float, other: float, console: str) -> None:
    """Say where estimates fit the truth in the meshes' frames, and not in the dataset's: the median
    ADD in the dataset's, and in the meshes' [mm].
    """
    if other < 0.5 * own:
        sentence = (
            f"the poses fit the meshes' frames (median ADD {other:.1f} mm) better than "
            f"the dataset's ({own:.1f} mm), in which they are scored: predict.py and track.py "
            "frames=... write poses of the mesh's frame, evaluate.py and track.py data=... of the "
            "dataset's"
        )
        warn(console, sentence, median_mm=own, median_mm_in_mesh_frame=other)


def data_settings(
    job: Job, trained: dict[str, Any], name: str | None, part: str = "test"
) -> DictConfig:
    """Return the settings of the data to test on, or with `part` "val" to calibrate on.

    Without `data=` they are those that the checkpoint was trained with: its held-out test split,
    and it must lie where `check_data` lets it. With it, object and image size are the checkpoint's
    unless typed; the split and its seed are the checkpoint's where it was trained on the same
    folder, and else every frame is tested, as it is of another of BOP's splits.
    """
    given = to_plain(job.cfg.data) if job.cfg.get("data") else {}
    own = trained.get("data") or {}
    pairs = [
        o.lstrip("+~").partition("=") for o in job.overrides if o.lstrip("+~").startswith("data.")
    ]
    typed = {key.removeprefix("data."): value.strip("'\"") for key, _, value in pairs}
    chosen, typed_split = "_target_" in given, any(map(_is_of_split, typed))
    if own and not chosen and "_target_" not in own:
        raise UserError(
            "data: exported weights carry no dataset; give "
            "data=fat|ycb_video|bop|scenes and data.root=DIR"
        )
    settings = dict(given) if chosen else changed({"data": own}, {"data": given})["data"]
    if "split" in typed:  # typed whole, it replaces the checkpoint's
        settings["split"] = given["split"]
    settings["augment"] = {}
    tree = {**trained, "data": settings, "seed": trained.get("seed", 0)}
    if chosen and own:
        before = OmegaConf.create(trained).data
        for key in OF_THE_CHECKPOINT:
            if key not in typed:
                settings[key] = name if key == "object" else before.get(key)
        root = OmegaConf.create(tree).data.root
        if root is None:
            raise UserError("data.root: is missing; name the dataset's folder")
        same = (
            "root" in before
            and Path(root).resolve() == Path(before.root).resolve()
            and _bop_split(settings) == _bop_split(own)
        )
        if not typed_split:
            settings["split"] = before.split if same else {part: 1.0}
        if "split_seed" not in typed and (same or not typed_split):
            settings["split_seed"] = before.get("split_seed", settings.get("split_seed", 0))
        if "limit_test" not in typed:
            settings["limit_test"] = before.limit_test if same else None
        if same and "min_visibility_test" not in typed:
            settings["min_visibility_test"] = before.min_visibility_test
    elif (chosen or _bop_split(settings) != _bop_split(own)) and not typed_split:
        settings["split"] = {part: 1.0}
    data = OmegaConf.create({**tree, "data": settings}).data
    OmegaConf.resolve(data)
    if not chosen:
        check_data(to_plain(data), typed)
    if data.get("generate") and not any(key.startswith("generate") for key in typed):
        data.generate = None  # a mistyped folder must not be filled with a new dataset
    return data


def check_own_folders(data: DictConfig, job: Job) -> None:
    """Raise UserError where a checkpoint's own dataset or meshes are not there: their folders may
    be relative to the one in which it was trained.

    Args:
        data: What `data_settings` returns.
        job: Folders that are typed, or of a dataset that is chosen by `data=`, are not looked at.
    """
    keys = {key_of(one).removeprefix("data.") for one in job.overrides}
    given = job.cfg.get("data") or {}
    if "_target_" in given:
        return
    rendered = any(key.startswith("generate") for key in keys)
    for key in ("meshes",) if rendered else ("root", "meshes"):
        folder = data.get(key)
        if key in keys or not isinstance(folder, str) or folder == "builtin":
            continue
        if not Path(folder).is_dir():
            raise UserError(no_own_folder(key, folder))


def _is_of_split(key: str) -> bool:
    """Return whether a setting of the data says what is tested, as `split_seed` alone does not."""
    return key == "split" or key.startswith("split.")


def _bop_split(data: Mapping[str, Any]) -> Any:
    """Return which folder of a dataset in BOP's layout is read, such as train_pbr."""
    options = data.get("options")
    return options.get("split") if isinstance(options, Mapping) else None


def judge_by(method: PoseEstimator, theirs: ObjectModel) -> None:
    """Give a method the object that a dataset judges it by, see `object_to_judge`.

    A calibration of an object without symmetries knows other features than one of an object with
    some: where the dataset disagrees with the checkpoint, it is left out.
    """
    known, declared = len(method.object_model.symmetries), len(theirs.symmetries)
    if (known > 1) != (declared > 1):
        method.calibration = None
        method.calibration_note = (
            f"the dataset's meshes declare {declared - 1} symmetries of {theirs.name}, and the "
            f"checkpoint was calibrated with {known - 1}"
        )
    method.set_object(theirs)


def object_to_judge(data: PoseDataModule, own: ObjectModel) -> ObjectModel:
    """Return the method's object with the points that the dataset defines ADD on, its symmetries
    and its parts, where the dataset's meshes have it.

    Raises UserError where its mesh there is another one: poses of the two could not be compared.
    """
    data.reader.check_diameter(own.name, own.diameter)
    if not data.meshes.has(own.name):
        return own
    if data.objects != (own.name,):
        raise UserError(
            f"data.object={', '.join(data.objects)}: the checkpoint was trained on {own.name}; "
            "leave data.object out"
        )
    theirs = data.object_model(0)
    shift = float((theirs.center - own.center).norm())
    if shift > _SAME_OBJECT or abs(theirs.radius - own.radius) > _SAME_OBJECT:
        raise UserError(
            f"data.meshes={data.meshes.root}: its {own.name} is not the mesh that the checkpoint "
            f"was trained on (center {1000 * shift:.1f} mm off, radius {1000 * theirs.radius:.1f} "
            f"mm against {1000 * own.radius:.1f} mm)"
        )
    return own._replace(
        points=theirs.points,
        diameter=theirs.diameter,
        symmetries=theirs.symmetries,
        parts=theirs.parts,
    )
