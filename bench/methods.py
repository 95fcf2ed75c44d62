"""Run every run behind docs/results, the most telling first, and bring its tables up to date
after each line of the plan.

    python bench/methods.py [--only TABLE] [--list] [--root outputs/methods] [KEY=VALUE ...]
    python bench/methods.py --meshes DIR --frames DIR    # and the real cracker box

`--only` may be repeated; the real cracker box needs YCB's meshes and YCB-Video's frames.

Each line of the plan is one sweep of train.py, or of evaluate.py on checkpoints of earlier lines,
and is printed as it could be typed. Started again, it goes on: train.py skips the jobs that are
done and resumes the one that was cut short. What is typed beyond the options, such as threads=1, is
handed to every command.
"""

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from programs import make_parser, run_command

from posefilter.cli.ablations import DETECTORS, WITH_POSE, list_pose_space_ablations

FOUR = "model=downsized,cnn_patch,pixel_pf,patch_pf"
MODELS = (*DETECTORS, *WITH_POSE)
# but for the normalizations' statistics
UNTRAINED = "optimizer.lr=0 trainer.max_steps=2 trainer.val_check_interval=2"
# of the displacement, not stated in the paper; the first is the default
UNITS = "model.displacement.unit=half_frame,10,1,learned"
# the paper with one modification, and the first two of the ladder: the others bound displacements
UNBOUNDED = (
    "s1_glimpse,s3_balanced,s4_displacement_loss,s5_position,s6_informed,s7_context,s8_resample,"
    "s9_displacement_loss_and_position,c1_normalization,c2_glimpse"
)
SHIPPED = "weights/003_cracker_box.ckpt"  # of pose_pf
MEMORISED = "memorize/experiment=memorize,model={},seed=0,variant=working"
HELD_OUT = "held_out/model={},seed=0"
OTHER_RUN = "objects/{}/*model={},*"  # its name is cut
SELF_SUPERVISED = "outputs/self_supervised/resnet18.pt"  # of bench/self_supervised.py
SPARSE_RUN = "sparse/{}/*encoder={},*seed={},*"
OTHER_OBJECTS = ("009_gelatin_box", "006_mustard_bottle", "004_sugar_box", "002_master_chef_can")
POSE_ROWS = "model=pose_pf sweep=ablation_pose_pf"
POSE_RUN = "ablation_pose_pf/ablation={},model=pose_pf,seed=0,sweep=ablation_pose_pf"
# the paper's variant small enough for many rows; detectors at the unit at which they gain, since
# where nothing works no choice can tell
SMALL = "model={} experiment=memorize sweep=ablation ablation=paper callbacks=checkpoints"
SMALL_BOXES = (
    "model={} experiment=memorize sweep=ablation_detect ablation={} filter.particles=8 "
    "model.net.width=16 callbacks=checkpoints"
)
SMALL_BOX = SMALL_BOXES.format("downsized", "paper")
BOX_RUN = "ablation_pose_pf_box/ablation={},*seed={},*"
POSE = "model=pose_pf data/augment=strong seed=0"  # its row is of the default of that time
# no loss on a part: the pose's head has no fragments, whose choice passes no gradient
END_TO_END = (
    "loss=belief_nll_pose loss/aux/displacement=none loss/aux/likelihood=none loss/aux/pose=none "
    "model.objectness_weight=0.0 model/train_rollout=resampled"
)
# kernels of the true pose three and four times as wide as the default's
WIDE = "loss.terms.pose.translation_mm=60 loss.terms.pose.rotation_deg=40"
VALUES = re.compile(r",(?![^\[{]*[\]}])")  # between values of a sweep: a list or a dict is one
TRAIN_RESAMPLE = "filter/resample@model.train_rollout.resample"


class Line(NamedTuple):
    """A sweep: the table (and folder) that it belongs to, its words, and the run or checkpoint that
    it evaluates, if any.
    """

    table: str
    words: str
    of: str | None = None
    into: str = ""  # a folder of its own below the table's


def plan(meshes: str | None = None, frames: str | None = None) -> list[Line]:
    """Return all lines, in order of what they tell; those on the real cracker box where its meshes
    and frames are given.
    """
    memorize = f"{FOUR} experiment=memorize"
    lines = [
        Line("memorize", f"{memorize} variant=working seed=0"),
        Line("memorize", f"{memorize} variant=working seed=1,2,3,4"),
        Line("untrained", f"{memorize} variant=paper {UNTRAINED} seed=0"),
        Line("memorize", f"{memorize} variant=paper seed=0"),
        Line(
            "roll_out",
            "model=cnn_patch,downsized experiment=memorize variant=paper "
            "filter.steps=3,10 seed=0,1,2",
        ),
    ]
    lines += vary_filter("resampling", "filter/resample=none,systematic,auxiliary", MEMORISED)
    lines += [
        Line(
            "ablation_detect", f"model={m} experiment=memorize sweep=ablation_detect seed=0", into=m
        )
        for m in DETECTORS
    ]
    lines += [Line("held_out", f"{FOUR} seed=0"), Line("held_out", POSE)]  # pose_pf beside them
    lines += vary_filter("particles", "filter.particles=10,20,50,100,300,1000", HELD_OUT)
    lines += vary_filter("iterations", "filter.steps=1,2,3,5,10,30,100", HELD_OUT)
    noise = "filter/propagate=learned,learned_and_gaussian filter.steps=10,100"
    lines += vary_filter("noise", noise, HELD_OUT, WITH_POSE)
    lines += [
        Line("ablation", f"model={m} experiment=memorize sweep=ablation seed=0", into=m)
        for m in WITH_POSE
    ]
    # does the gradient through the place harm where nothing multiplies it, and whose?
    short = (
        "model=patch_pf experiment=memorize sweep=ablation "
        "ablation=c5_displacement_loss,c6_position model/train_rollout=short"
    )
    lines += [
        Line(
            "detach_position",
            f"{short} loss/schedule=none,displacement_only,likelihood_only seed=0,1,2",
        ),
        # two steps alone, from where the paper's particles start
        Line(
            "short_start",
            f"{short} model.train_rollout.initialize.object_fraction=0.0 loss/schedule=none "
            "seed=0,1,2",
        ),
        # the classes balanced in the loss itself, and not in one more beside it
        Line(
            "class_balance",
            "model=patch_pf experiment=memorize sweep=ablation ablation=paper loss=balanced_bce "
            "seed=0,1,2",
        ),
    ]
    for models, sweep in ((WITH_POSE, "ablation"), (DETECTORS, "ablation_detect")):
        seeds = f"experiment=memorize sweep={sweep} seed=1,2"
        lines += [Line(sweep, f"model={m} {seeds}", into=f"{m}_seeds") for m in models]
        long = (
            f"experiment=memorize sweep={sweep} ablation=paper trainer.max_steps=2000 "
            "trainer.val_check_interval=2000 seed=0"
        )
        lines += [Line("paper_longer", f"model={','.join(models)} {long}", into=sweep)]
    lines += [
        Line("untrained", f"{memorize} variant=paper {UNTRAINED} seed=1,2,3,4"),
        Line("memorize", f"{memorize} variant=paper seed=1,2,3,4"),
        *list_units(),
        *list_end_to_end(),
        Line("held_out", f"{FOUR} seed=1,2"),
        Line(
            "held_out_less",
            "model=patch_pf "
            "ablation=m9_context,pose_m17_fragments,m11_muon,m5_displacement_loss seed=0",
        ),
        *vary_filter("held_out_less", "filter/resample=none", HELD_OUT, ("patch_pf",)),
        Line("patch", "model=patch_pf experiment=memorize sweep=patch seed=0"),
    ]
    lines += [*list_pose_space(), *list_paper(), *list_choices(), *list_long()]
    lines += [*list_units_at_full_size(), *list_units_of_ablations(), *list_sparse()]
    lines += list_pretrained()
    if meshes:
        box = f"{FOUR} experiment=cracker_box_pixels data.meshes={meshes} seed=0"
        lines.append(Line("cracker_box", box))
        # the scenes of the lines above, dealt as for them
        renders = (
            f"data=fat data.root=outputs/data/003_cracker_box data.meshes={meshes} "
            "data.min_visibility_test=0.3 data.split={train:0.7407,val:0.0741,test:0.1852}"
        )
        lines.append(Line("shipped", renders, SHIPPED, "renders"))
    if meshes and frames:
        real = f"data=ycb_video data.root={frames} data.meshes={meshes}"
        runs = {
            model: f"cracker_box/experiment=cracker_box_pixels,model={model},seed=0"
            for model in MODELS
        }
        lines += [Line("real_frames", real, run, model) for model, run in runs.items()]
        lines.append(Line("shipped", real, SHIPPED, "photographs"))
    if meshes:
        lines += [*list_other_objects(meshes, frames), *list_pose_on_photographs(meshes, frames)]
    return lines


def list_pose_on_photographs(meshes: str, frames: str | None) -> list[Line]:
    """Return the ablations of pose_pf on renders of the real cracker box, with the augmentation
    that imitates a camera, and on the photographs that show it.
    """
    box = "data.object=003_cracker_box data.root=outputs/data/003_cracker_box_small"
    at = f"{box} data.meshes={meshes} data/augment=camera"
    lines = [
        line._replace(table="ablation_pose_pf_box", words=f"{line.words} {at}")
        for seed in range(3)
        for line in list_pose_rows(f"seed={seed}")
    ]
    if frames:
        real = f"data=ycb_video data.root={frames} data.meshes={meshes}"
        lines += [
            Line("ablation_pose_pf_frames", real, BOX_RUN.format(name, seed), f"{name}/{seed}")
            for name in list_pose_space_ablations()
            for seed in range(3)
        ]
    return lines


def list_other_objects(meshes: str, frames: str | None) -> list[Line]:
    """Return the methods in image space on other objects of YCB, for half of the cracker box's
    steps, and on the photographs that show them.
    """
    lines = []
    for name in OTHER_OBJECTS:
        at = (
            f"experiment=cracker_box_pixels data.object={name} data.root=outputs/data/{name} "
            f"data.meshes={meshes} data/augment=camera_full_image seed=0"
        )
        for models, steps in ((DETECTORS, 1500), (WITH_POSE, 3000)):
            size = f"trainer.max_steps={steps} trainer.val_check_interval={steps // 2}"
            lines.append(Line("objects", f"model={','.join(models)} {at} {size}", into=name))
        foveated = f"model=patch_pf model/encoder=foveated {at} {size}"
        lines.append(Line("objects_foveated", foveated, into=name))
    if frames:
        real = "data=ycb_video data.root={} data.meshes={} data.object={}"
        lines += [
            Line(
                "object_frames",
                real.format(frames, meshes, name),
                OTHER_RUN.format(name, model),
                f"{name}/{model}",
            )
            for name in OTHER_OBJECTS
            for model in MODELS
        ]
        lines += [
            Line(
                "object_frames_foveated",
                real.format(frames, meshes, name),
                f"objects_foveated/{name}/*",
                name,
            )
            for name in OTHER_OBJECTS
        ]
    return lines


def list_units() -> list[Line]:
    """Return the runs of the paper's variant over the unit of its displacement: without training,
    at the paper's size and at that of the ablations; then memorizing: the filter with a pose at
    the size of the ablations (a narrower network, ten steps), detectors with 8 particles and 16
    channels, for time, and the paper's 30 steps.
    """
    untrained = f"experiment=memorize variant=paper {UNTRAINED} callbacks=checkpoints"
    lines = [
        Line("unit_untrained", f"{FOUR} {untrained} {UNITS} seed=0,1,2"),
        # what to hold the other seeds of unit_full against
        Line(
            "unit_untrained",
            f"model=patch_pf {untrained} model.displacement.unit=10,1,learned seed=3,4",
        ),
        Line(
            "unit_untrained",
            f"model=downsized,cnn_patch,pixel_pf {untrained} "
            "model.displacement.unit=10,1,learned seed=3,4",
            into="more_seeds",
        ),
    ]
    paper = "experiment=memorize ablation=paper callbacks=checkpoints"
    # what to hold the trained filter with a pose against
    lines.append(
        Line(
            "untrained_small",
            f"model=patch_pf {paper} sweep=ablation {UNTRAINED} "
            "model.displacement.unit=half_frame,10,1 seed=0,1,2",
        )
    )
    for model in ("patch_pf", "downsized", "cnn_patch"):
        size = "sweep=ablation"
        if model in DETECTORS:
            size = "sweep=ablation_detect filter.particles=8 model.net.width=16"
        lines.append(Line("unit", f"model={model} {paper} {size} {UNITS} seed=0,1,2"))
    return lines


def list_units_at_full_size() -> list[Line]:
    """Return the same at the paper's size, memorizing; half a frame is the table `memorize`, and
    for the detectors, whose failure it is, here again.
    """
    paper = "experiment=memorize variant=paper callbacks=checkpoints"
    lines = []
    for model in ("downsized", "cnn_patch", "pixel_pf", "patch_pf"):
        units = "half_frame,1,10,learned" if model in DETECTORS else "1,10,learned"
        choice = f"model.displacement.unit={units} seed=0,1,2,3,4"
        lines.append(Line("unit_full", f"model={model} {paper} {choice}", into=model))
    return lines


def list_units_of_ablations() -> list[Line]:
    """Return patch_pf's ablations whose displacement has a unit, for 1 and 10 pixels besides half a
    frame; and bounds of the detectors apart from the unit, one of them the step of the unbounded
    one at 10 pixels.
    """
    seeds = "seed=0,1,2"
    some = "model=patch_pf experiment=memorize sweep=ablation callbacks=checkpoints"
    lines = [
        Line("ablation_unit", f"{some} ablation={UNBOUNDED} model.displacement.unit=1,10 {seeds}"),
    ]
    for model in DETECTORS:
        bounded = SMALL_BOXES.format(model, "s2_bounded")
        lines.append(
            Line(
                "bounded_unit",
                f"{bounded} model.displacement.max_displacement=0.5,0.25,0.03125 {seeds}",
                into=model,
            )
        )
    return lines


def list_sparse() -> list[Line]:
    """Return patch_pf on held-out scenes with less and less of the image besides a particle's own
    patch, for half the preset's steps; and for the first of these runs guided starts and
    resampling when testing, as the paper's last section proposes.
    """
    patch = "model=patch_pf trainer.max_steps=3000 trainer.val_check_interval=3000"
    seeds = "seed=0,1,2"
    unet = f"{patch} model/encoder=unet"
    guided = (
        "filter/initialize=uniform,from_objectness "
        "filter/resample=none,systematic,auxiliary filter.particles=32,128"
    )
    return [
        Line("sparse", f"{unet} {seeds}", into="unet"),
        Line("sparse", f"{patch} model/encoder=foveated,none,pyramid {seeds}", into="others"),
        Line("sparse", f"{unet} model.encoder.max_width_px=80,40 {seeds}", into="narrow"),
        Line("sparse", f"{patch} model/encoder=foveated data.image_width=320 {seeds}", into="wide"),
        # against the first line
        Line("stages", f"{unet} loss/schedule=three_stages {seeds}"),
        *(
            # the row of a test has the seed of its draws: that of the training as well
            Line(
                "guided",
                f"{guided} seed={seed}",
                SPARSE_RUN.format("unet", "unet", seed),
                into=f"seed{seed}",
            )
            for seed in range(3)
        ),
        *(
            # a table each: rows of tests do not say what was trained
            Line(
                f"sparse_particles_{encoder}",
                f"filter.particles=8,32 seed={seed}",
                SPARSE_RUN.format(folder, encoder, seed),
                into=str(seed),
            )
            for encoder, folder in (("unet", "unet"), ("foveated", "others"), ("none", "others"))
            for seed in range(3)
        ),
    ]


def list_pretrained() -> list[Line]:
    """Return patch_pf on held-out scenes with features of a ResNet from random weights and from
    those of bench/self_supervised.py, which must have made the file before, trained on and frozen;
    beside the U-Net of the default. The trunk ends at a stride of 16 pixels, and a training has a
    quarter of the preset's steps, for time. Muon turns all directions of a kernel at one rate, and
    may so undo what was learned before: in the last line the trunk is left to AdamW.
    """
    patch = "model=patch_pf trainer.max_steps=1500 trainer.val_check_interval=1500"
    resnet = f"{patch} model/encoder=resnet model.encoder.trunk.stages=3"
    learned = f"model.encoder.trunk.weights={SELF_SUPERVISED}"
    either = f"model.encoder.trunk.weights=null,{SELF_SUPERVISED}"
    layers = "optimizer.adam_layers=[color,enter,modulate,outside,leave,out,trunk]"
    return [
        Line("pretrained", f"{resnet} seed=0,1,2 {either}", into="trained"),
        Line(
            "pretrained",
            f"{resnet} seed=0,1,2 {learned} model.encoder.trunk.frozen=true",
            into="frozen",
        ),
        Line("pretrained", f"{patch} seed=0,1,2 model/encoder=unet", into="unet"),
        Line("pretrained", f"{resnet} seed=0,1,2 {either} {layers}", into="adamw"),
    ]


def list_end_to_end() -> list[Line]:
    """Return trainings by the density of the truth under the particles against those by a loss on
    each part, with the same head and number of steps; all are tested with the same filter.
    """
    lines = []
    for table, data, steps in (
        ("end_to_end", "experiment=memorize", 200),
        (
            "end_to_end_held_out",
            "data.generate.frames=400 data.split.train=0.6 data.split.val=0.1 data.split.test=0.3",
            1000,
        ),
    ):
        patch = f"model=patch_pf {data} " + (
            "variant=working model/pose_head=surface_point scheduler.warmup_steps=50 "
            f"trainer.max_steps={steps} trainer.val_check_interval={steps} callbacks=checkpoints "
            "seed=0,1,2"
        )
        whole = f"{patch} {END_TO_END} {TRAIN_RESAMPLE}"
        parts = f"{patch} loss=confidence model/train_rollout"
        both = f"{patch} loss=belief_nll_pose model/train_rollout=resampled"
        if table == "end_to_end":
            every = f"{whole}=systematic,soft,optimal_transport"
            pixel = (
                line.replace("patch_pf", "pixel_pf") for line in (f"{parts}=short", f"{whole}=soft")
            )
            lines += [
                Line(table, every),
                Line(table, f"{parts}=short,resampled", into="parts"),
                Line(table, f"{every} loss.steps=last", into="last"),
                Line(table, both, into="both"),
                *(Line(table, line, into="pixel_pf") for line in pixel),
            ]
        else:
            lines += [
                Line(table, f"{parts}=short"),
                Line(table, f"{parts}=resampled", into="parts"),
                Line(table, f"{whole}=soft", into="whole"),
                Line(table, f"{whole}=optimal_transport", into="transport"),
                Line(table, f"{whole}=soft {WIDE}", into="wide"),
                Line(table, both, into="both"),
            ]
    return lines


def list_pose_rows(seeds: str) -> list[Line]:
    """Return the ablations of pose_pf in three lines, which share a folder and so their trainings:
    what is taken from the working variant, what is added to the paper's, and alone.
    """
    names = list_pose_space_ablations()
    series = [[n for n in names if n.startswith(f"pose_pf_{kind}")] for kind in "mcs"]
    first = ["working", "paper", *series[0]]
    return [
        Line("ablation_pose_pf", f"{POSE_ROWS} ablation={','.join(some)} {seeds}")
        for some in (first, *series[1:])
    ]


def list_pose_space() -> list[Line]:
    """Return the runs of pose_pf on held-out scenes at the size of `experiment=small_scenes`: every
    ablation; and of one run, sizes of the filter.
    """
    working, paper = (POSE_RUN.format(variant) for variant in ("working", "paper"))
    counts = "25,50,100,200,400,1000"
    return [
        *list_pose_rows("seed=0"),
        Line("pose_filter", f"filter.particles={counts}", working, "kept"),
        Line("pose_filter", f"filter.initial_particles={counts}", working, "first"),
        Line(
            "pose_filter",
            f"filter.initial_particles=null filter.particles={counts}",
            working,
            "both",
        ),
        Line("pose_filter", "filter.steps=1,2,3,5,10,20,50", working, "steps"),
        Line("pose_filter", "filter.particles=100,400 filter.steps=10,30", paper, "paper"),
    ]


def list_paper() -> list[Line]:
    """Return the paper's experiments that the other tables lack, at the small size."""
    patch, seeds = SMALL.format("patch_pf"), "seed=0,1,2"
    units = "model.displacement.unit=half_frame,1"
    return [
        Line("paper_add", f"{patch} loss=add {units} {seeds}"),
        Line("paper_offset", f"{SMALL_BOX} loss=offset {units} {seeds}"),
        Line("paper_informed", f"{patch} filter/initialize=informed {units} {seeds}"),
        Line("paper_patch", f"{patch} model.glimpse.size=3,6 filter.particles=50,100 {seeds}"),
    ]


def list_choices() -> list[Line]:
    """Return the runs over what the paper leaves open, the cheapest size at which one can tell:
    rows of docs/methods/choices.md. What they are held against is in `unit`, `paper_add` and
    `ablation_pose_pf`.
    """
    unit, seeds = "model.displacement.unit=1", "seed=0,1,2"
    detector, patch = f"{SMALL_BOX} {unit}", SMALL.format("patch_pf")
    pose, pixel = f"{POSE_ROWS} ablation=paper", SMALL.format("pixel_pf")
    return [
        Line("choices", f"{pixel} loss=add loss.weighting=mean,likelihood {seeds}"),
        Line("choices", f"{patch} {unit} model.net.displacement_input=logit,likelihood {seeds}"),
        *(
            Line("choices", f"{size} {last} model.displacement.unit=half_frame,1 seed=0,1,2,3,4")
            for last in ("model.net.last_layer=relu", f"model.net.last_layer=relu {UNTRAINED}")
            for size in (pixel, patch)
        ),
        Line("choices", f"{patch} loss=add loss.weighting=likelihood {seeds}"),
        Line("choices", f"{detector} loss=chamfer_rgbd {seeds}"),
        Line("choices", f"{detector} loss.max_pixels=null {seeds}"),
        Line("choices", f"{detector} model.net.kernel=1,5 {seeds}"),
        Line("choices", f"{SMALL_BOX} optimizer.lr=0.0001,0.01 {seeds}"),
        Line("choices", f"{pose} model.likelihood.anchor=center seed=0"),
        Line("choices", f"{pose} model.likelihood.spread=0.3,1.2 seed=0"),
    ]


def list_long() -> list[Line]:
    """Return what takes an hour or more a line: more seeds of pose_pf's ablations, its variants for
    longer and with augmentation; the paper's experiments at its size; and its samples, all of them.
    """
    paper = "model=patch_pf experiment=memorize variant=paper callbacks=checkpoints"
    boxes = "model=cnn_patch,downsized experiment=memorize variant=paper callbacks=checkpoints"
    pose = f"{POSE_ROWS} ablation=paper"
    longer = "trainer.max_steps=3000 trainer.val_check_interval=600 seed=0"
    augment = "data/augment=strong,camera seed=0,1,2"
    sizes = "model.glimpse.size=6 filter.particles=50,100"
    return [
        *list_pose_rows("seed=1,2"),
        Line("paper_offset", f"{boxes} loss=offset seed=0,1,2", into="full"),
        Line("pose_longer", f"{POSE_ROWS} ablation=paper,working {longer}"),
        Line("pose_augment", f"{POSE_ROWS} ablation=working {augment}"),
        Line("paper_add", f"{paper} loss=add seed=0", into="full"),
        Line("paper_informed", f"{paper} filter/initialize=informed seed=0", into="full"),
        Line("choices", f"{pose} model.candidate_sampler.rays=16,256 seed=0"),
        Line("paper_patch", f"{paper} {sizes} seed=0", into="full"),
        Line(
            "paper_patch", f"{paper} model.glimpse.size=3 filter.particles=100 seed=0", into="full"
        ),
        Line("paper_add", f"{paper} loss=add seed=1,2", into="full"),
        Line("paper_informed", f"{paper} filter/initialize=informed seed=1,2", into="full"),
    ]


def vary_filter(table: str, swept: str, run: str, models: Sequence[str] = MODELS) -> list[Line]:
    """Return sweeps at test time over choices of the filter, on methods' runs."""
    return [Line(table, swept, run.format(model), model) for model in models]


def command(line: Line, root: Path, more: Sequence[str] = ()) -> list[str]:
    """Return what to run, from the project's folder."""
    out = root / line.table / line.into
    if line.of is None:
        return ["train.py", "-m", *line.words.split(), f"out={out}", "console=json", *more]
    # Hydra's grammar
    quoted = str(evaluated(line.of, root)).replace("=", r"\=").replace(",", r"\,")
    words = [f"checkpoint={quoted}", *line.words.split(), f"out={out}", "console=json"]
    return ["evaluate.py", "-m", *words, *more]


def evaluated(of: str, root: Path) -> Path:
    """Return the checkpoint of a run, whose name may hold a `*`, or the one that is named."""
    if of.endswith(".ckpt"):
        return Path(of)
    run = min(root.glob(of), default=root / of) if "*" in of else root / of
    return run / "checkpoints" / "best.ckpt"


def waits(line: Line, root: Path) -> bool:
    """Tell whether an evaluation has no checkpoint yet, or all its points were evaluated after that
    was made.
    """
    if line.of is None:
        return False
    checkpoint = evaluated(line.of, root)
    if line.of != str(checkpoint) and not (checkpoint.parents[1] / "metrics.json").is_file():
        return True
    made = checkpoint.stat().st_mtime
    found = (root / line.table / line.into).glob("*/metrics.json")
    done = sum(path.stat().st_mtime > made for path in found)
    return done >= math.prod(len(VALUES.split(word)) for word in line.words.split())


def main() -> int:
    """Run the plan; the status is that of the worst line."""
    parser = make_parser(__doc__)
    parser.add_argument("more", nargs="*")
    parser.add_argument(
        "--only", action="append", choices=sorted({line.table for line in plan("DIR", "DIR")})
    )
    parser.add_argument(
        "--meshes", help="a folder of YCB's meshes: learn the real cracker box from renders as well"
    )
    parser.add_argument("--frames", help="a folder of YCB-Video: and test on its photographs")
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    parser.add_argument("--root", type=Path, default=Path("outputs/methods"))
    options = parser.parse_args()
    worst = 0
    for line in plan(options.meshes, options.frames):
        if options.only and line.table not in options.only:
            continue
        skip = options.list or waits(line, options.root)
        worst = max(worst, run_command(command(line, options.root, options.more), skip))
        if not skip:
            run_command(["bench/collect_runs.py", str(options.root)])
    return worst


if __name__ == "__main__":
    sys.exit(main())
