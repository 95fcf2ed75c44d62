"""From a mesh to trained weights and a report, in stages; it goes on where it was interrupted."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from omegaconf import DictConfig, OmegaConf

from posefilter.callbacks.time_budget import TimeBudget
from posefilter.cli.arguments import quote
from posefilter.cli.build import build_data
from posefilter.cli.calibrate import learn
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.choices import check_choices
from posefilter.cli.command import compose_job
from posefilter.cli.console import ended, say, setting, typed, typed_prediction, warn
from posefilter.cli.export import strip, write_weights
from posefilter.cli.files import save_whole
from posefilter.cli.folders import hold_folder, move_evaluation, own_metrics
from posefilter.cli.job import Job, write_job
from posefilter.cli.machine import settle
from posefilter.cli.measure_speed import Speed, measure_speed
from posefilter.cli.onboarded_mesh import find_and_draw, find_declared, read_onboarded, write_meshes
from posefilter.cli.plain import key_of, resolve, unresolved
from posefilter.cli.report import compared, write_page
from posefilter.cli.resume import LAST
from posefilter.cli.reuse import step_of
from posefilter.cli.stages import Stages
from posefilter.cli.train import build, finish, fit, read_trained, test
from posefilter.confidence.fit import FEWEST
from posefilter.data.generated_scenes import count_frames
from posefilter.devices import choose_device
from posefilter.errors import UserError
from posefilter.forms import NUMBER, TEXT
from posefilter.meshes.inspect_mesh import list_concerns
from posefilter.meshes.mesh import Mesh
from posefilter.paths import check_links, find_conf
from posefilter.report.diagnostics import format_duration
from posefilter.report.gather import read_run
from posefilter.report.onboarding_page import make_onboarding_page

RECORD = "onboarding.json"
_SPEED = ("seconds_per_step", "seconds_per_image")  # known once some frames are rendered
_PLANNED = ("steps", *_SPEED, "seconds_per_frame")  # the steps, once the training begins
FOUND = {**dict.fromkeys(_PLANNED, NUMBER), "concerns": [TEXT], "facts": {}, "training": {}}
_FRAMES_A_MINUTE, _FEWEST_FRAMES, _MOST_FRAMES = 100, 200, 6000
_FEWEST_STEPS, _MOST_STEPS = 100, 20000
# Rendered, at most, as those in which enough of the object is seen are fewer.
_VAL_FRAMES, _TEST_FRAMES = 90, 120
_VALIDATED = 8  # images, once at the end
_CALIBRATED = 40  # images with the object, and as many without
_POINTS = 2000  # of the surface, as the shipped files have: the alignment with the depth uses them
_REST = 25.0  # [s] reserved for figures, weights and report
_OWN = {
    "data.generate.frames": "frames",
    "data.generate.seed": "seed",
    "data.limit_test": "test_frames",
    "seed": "seed",
}
# The learning rate keeps pace with the clock, so that a training of too many steps ends in time,
# and one of too few leaves time unused. So steps are hoped to be shorter than the measured one, and
# never taken for longer than this, however busy the machine was then [s].
_HOPED, _SLOWEST = 0.75, 0.4


_RENDERED = "data.generate."  # settings of a training that are those of its renders


class Stage(NamedTuple):
    """A part of the work."""

    name: str
    doing: str  # in words
    settings: tuple[str, ...]  # of the work, which decide its result
    do: Callable[["Onboarding"], None]
    costly: bool = False


class Onboarding:
    """What is asked for, and where it goes."""

    def __init__(self, cfg: DictConfig, mesh: Mesh, out: Path, stages: Stages) -> None:
        self.cfg, self.mesh, self.out, self.stages = cfg, mesh, out, stages
        self.data, self.training = out / "data", out / "training"  # renders; the run's folder
        self.weights = out / f"{mesh.name}.ckpt"  # the file that predicts

    @cached_property
    def frames(self) -> int:
        """How many frames are rendered."""
        if self.cfg.frames is not None:
            return int(self.cfg.frames)
        wanted = round(_FRAMES_A_MINUTE * self.cfg.budget_minutes)
        return min(_MOST_FRAMES, max(_FEWEST_FRAMES, wanted))

    @cached_property
    def mesh_digest(self) -> str:
        """What decides how the mesh looks, in short."""
        mesh = self.mesh
        parts = (mesh.vertices, mesh.faces, mesh.texture, mesh.corner_colors, mesh.corner_uv)
        content = b"".join(np.asarray(part).tobytes() for part in parts if part is not None)
        return sha256(content).hexdigest()[:16]

    @property
    def digests(self) -> dict[str, str]:
        """What stages depend on beside settings: the mesh, and the symmetries that are in use."""
        file = self.out / "meshes" / self.mesh.name / "symmetries.json"
        own = str(self.cfg.symmetries)
        own = "found" if own == "auto" else own  # as records of earlier versions have it
        content = Path(own).read_bytes() if Path(own).is_file() else own.encode()
        return {
            "mesh": self.mesh_digest,
            "symmetries": sha256(content).hexdigest()[:16],
            "used": sha256(file.read_bytes()).hexdigest()[:16] if file.is_file() else "",
        }

    def settings_of(self, stage: Stage) -> dict[str, Any]:
        """Return all that decides a stage's result."""
        known = {**self.digests, "frames": self.frames, "name": self.mesh.name}
        known["train_overrides"] = unresolved(self.cfg.get("train_overrides"))
        found = {
            key: known[key] if key in known else resolve(self.cfg.get(key))
            for key in stage.settings
        }
        words = map(str, self.cfg.get("train_overrides") or ())
        rendered = sorted(one for one in words if key_of(one).startswith(_RENDERED))
        if rendered and stage.name == "render":  # else as records of earlier versions have it
            found["train_overrides"] = rendered
        return found

    def job(self, folder: Path, *more: str, frames: int | None = None) -> Job:
        """Return the training, as one of a sweep: begun before, it is resumed.

        Args:
            folder: Where its files go.
            *more: Settings that beat all others.
            frames: How many of the renders it has; None: all.
        """
        frames = frames or self.frames
        quoted = {"data.object": self.mesh.name, "data.root": self.data}
        quoted |= {"data.meshes": self.out / "meshes"}
        words = [
            "model=pose_pf",
            "filter.magnified_width=0.4",
            "filter.max_searches=4",
            "data=scenes",
            "data/augment=camera_magnified",  # as the magnified windows are
            *(f"{key}={quote(value)}" for key, value in quoted.items()),
            f"data.generate.frames={frames}",
            f"data.generate.workers={self.cfg.workers}",
            "data.generate.frames_per_scene=2",  # few scenes would be learned by heart
            "data.generate.lookalike_texture=different",
            f"data.generate.seed={self.cfg.seed}",
            f"data.split={_split(frames)}",
            f"data.limit_val={_VALIDATED}",
            f"data.limit_test={self.cfg.test_frames}",
            f"seed={self.cfg.seed}",
            f"threads={'null' if self.cfg.threads is None else self.cfg.threads}",
            f"console={self.cfg.console}",
        ]
        start = resolve(self.cfg.warm_start)
        if isinstance(start, list):
            words.append("warm_start=[" + ",".join(map(quote, start)) + "]")
        elif start is not None:
            words.append(f"warm_start={quote(start)}")
        words += [*unresolved(self.cfg.train_overrides), *more]
        return replace(compose_job("train", find_conf(), words, folder), swept=True)

    @cached_property
    def run(self) -> Any:
        """The training, built: its steps are known by then."""
        steps = int(self.stages.values["steps"])
        words = (f"trainer.max_steps={steps}", f"trainer.val_check_interval={steps}")
        job = self.job(self.training, *words)
        write_job(job)
        return build(job)

    @property
    def speed(self) -> Speed | None:
        """Of the training, as it was measured; None: not yet, or with other `train_overrides`."""
        own = unresolved(self.cfg.get("train_overrides"))
        if self.stages.values.get("measured_with", own) != own:
            return None
        step, image = (self.stages.values.get(name) for name in _SPEED)
        return None if step is None or image is None else Speed(step, image)

    @property
    def spent(self) -> float:
        """How long the stages took that have ended [s]."""
        return sum(self.stages.seconds.values())

    @property
    def budget(self) -> float:
        """Time for everything [s]."""
        return float(60 * self.cfg.budget_minutes)

    @property
    def seconds_left(self) -> float | None:
        """How long the rest will take; of the budget, what is left, as long as nothing was measured
        [s].
        """
        speed, steps = self.speed, self.stages.values.get("steps")
        if speed is None:
            return None if self.cfg.steps else max(0.0, self.budget - self.spent)
        if steps is None:
            steps, seconds = self.plan(speed, self.spent)
            return float(steps * seconds) + self.to_render + self.rest(speed)
        if "train" not in self.ahead:
            return self.rest(speed)  # it may have ended by its time, before all of its steps
        done = 0
        with suppress(UserError):  # none yet, or a broken one
            done = step_of(self.training / "checkpoints" / LAST)
        return float(speed.step * (steps - done)) + self.rest(speed)

    @property
    def to_render(self) -> float:
        """How long the frames take that are not rendered yet [s]."""
        missing = max(0, self.frames - count_frames(self.data))
        return missing * float(self.stages.values.get("seconds_per_frame") or 0.0)

    def plan(self, speed: Speed, spent: float) -> tuple[int, float]:
        """Return the number of training steps, and how long one may take [s].

        Args:
            speed: As it was measured.
            spent: Time of all that was done [s].
        """
        if self.cfg.steps is not None:
            return int(self.cfg.steps), speed.step
        room = self.budget - spent - self.to_render - self.rest(speed)
        return choose_steps(room, speed.step)

    def rest(self, speed: Speed) -> float:
        """Return how long what follows the training, and is not done, takes [s]."""
        # frames with and without the object, run twice; doubtful ones, up to three times more each
        searches = 10 * min(_CALIBRATED, self.frames // 10)
        tested = min(int(self.cfg.test_frames), _TEST_FRAMES)  # which are rendered at most
        images = {"train": _VALIDATED, "calibrate": searches, "test": tested}
        seconds = speed.image * sum(images.get(name, 0) for name in self.ahead)
        return float(seconds + (_REST if self.ahead else 0.0))

    @property
    def ahead(self) -> list[str]:
        """The stages that are not done yet."""
        return [one.name for one in STAGES if not self.is_done(one)]

    @property
    def has_checkpoint(self) -> bool:
        """Whether the training has come to a checkpoint."""
        return any((self.training / "checkpoints").glob("*.ckpt"))

    def is_costly(self, stage: Stage) -> bool:
        """Tell whether other settings would spoil what a stage has made: a training that was
        refused before its first checkpoint has made nothing.
        """
        made = stage.name != "train" or self.has_checkpoint or self.stages.was_finished("train")
        return stage.costly and made

    def is_done(self, stage: Stage) -> bool:
        """Tell whether a stage was finished, with the settings that it would have now."""
        return self.stages.is_done(stage.name, self.settings_of(stage))


def onboard(job: Job) -> None:
    """Write weights, symmetries, renders, the training's run and a report."""
    cfg = job.cfg
    settle(cfg.threads, cfg.seed)
    if cfg.train_overrides:  # a mistake in them is told before anything is written
        overrides = unresolved(cfg.train_overrides)
        for key in ("trainer.max_steps", "trainer.val_check_interval"):
            if key in map(key_of, overrides):
                raise UserError(
                    f"train_overrides: {key} follows from budget_minutes; steps= sets the number"
                )
        for key, own in _OWN.items():  # which all stages reckon with
            if key in map(key_of, overrides):
                raise UserError(f"train_overrides: {key} is {own}= of this command")
        check_choices(overrides, find_conf(), "train")
        compose_job("train", find_conf(), overrides, Path())
    mesh = read_onboarded(cfg)
    out = Path(str(cfg.out)) if cfg.out else Path("outputs") / "onboard" / mesh.name
    check_links(out)  # somebody else may have begun it
    hold_folder(out)
    check_folder(out, str(cfg.symmetries), mesh.name)
    work = Onboarding(cfg, mesh, out, Stages(out / RECORD, FOUND))
    for stage in STAGES:  # before anything of an earlier run is overwritten
        if work.is_costly(stage):
            work.stages.check(stage.name, work.settings_of(stage))
    begun = {stage.name: stage for stage in STAGES if stage.name in work.stages.seconds}
    # a training learns from the symmetries that the stage before it wrote
    if "train" in begun and work.is_costly(begun["train"]):
        work.stages.check("symmetries", work.settings_of(begun["symmetries"]))
    for number, stage in enumerate(STAGES, 1):
        head = f"[{number}/{len(STAGES)}] {stage.doing}"
        if work.is_done(stage):
            say(cfg.console, "stage", f"{head}: done before", stage=stage.name, done=True)
            continue
        left = work.seconds_left
        if left is not None:
            duration = format_duration(left)
            known = work.speed is not None
            head += f"; about {duration} left" if known else f"; {duration} of the budget left"
        say(cfg.console, "stage", head, stage=stage.name, done=False, seconds_left=left)
        doing = partial(stage.do, work)
        work.stages.run(stage.name, work.settings_of(stage), doing, work.is_costly(stage))
    tell(work)


def check_folder(out: Path, symmetries: str, name: str) -> None:
    """Refuse a folder in which files of the user would be overwritten.

    Raises:
        UserError: It has meshes that no onboarding wrote, or the symmetries that are given are a
            file which this command writes.
    """
    meshes = out / "meshes"
    if meshes.exists() and not (out / RECORD).is_file():
        raise UserError(
            f"{meshes}: is no onboarding's, and would be overwritten; choose another out="
        )
    own = meshes / name / "symmetries.json"
    if own.exists() and Path(symmetries).exists() and own.samefile(symmetries):
        raise UserError(
            f"symmetries={symmetries}: is written by this command, in meters; give a copy of it "
            "elsewhere, in the unit of the mesh"
        )


def store_meshes(work: Onboarding) -> None:
    """Write the object and what stands beside it; say what may be wrong with the object."""
    facts, like = write_meshes(work.mesh, work.cfg, work.out / "meshes")
    concerns = list_concerns(facts)
    if like:
        concerns.append(f"left out of the distractors, since like the object: {', '.join(like)}")
    work.stages.keep(facts=facts._asdict(), concerns=concerns)
    size = " x ".join(f"{x:.0f}" for x in facts.size_mm)
    sentence = f"{work.mesh.name}: {size} mm, {facts.faces} triangles"
    say(work.cfg.console, "mesh", "\n".join([sentence, *concerns]), **facts._asdict())


def use_symmetries(work: Onboarding) -> None:
    """Find the object's symmetries, or take those given; draw them."""
    found = find_and_draw(work.mesh, str(work.cfg.symmetries), work.cfg.mesh_scale, work.out)
    work.stages.keep(symmetries=found)
    picture = work.out / "symmetries.png"
    sentence = f"{found}: {picture}; if that is wrong, give symmetries=none|geometry|FILE"
    declared = None
    if str(work.cfg.symmetries) == "auto":
        with suppress(UserError):  # a hint; the file is not asked for
            source = Path(str(work.cfg.mesh))
            declared = find_declared(source, work.mesh.name, work.cfg.mesh_scale)
    if declared is not None:
        file, count = declared
        sentence += f" ({file} declares {count}: {setting('symmetries', file)})"
    say(work.cfg.console, "symmetries", sentence, found=found, picture=str(picture))


def render(work: Onboarding) -> None:
    """Render what is missing; the training is measured as soon as there are frames enough for it,
    so that a budget which is too short is told before most of the time is spent.
    """
    if work.speed is None:
        began, before = time.perf_counter(), count_frames(work.data)
        few = work.job(work.out / ".trial", frames=min(work.frames, _FEWEST_FRAMES))
        render_scenes(few)
        rendered = count_frames(work.data) - before
        if rendered > 0:
            work.stages.keep(seconds_per_frame=(time.perf_counter() - began) / rendered)
        measure(work, few, began)
    render_scenes(work.job(work.training))


def render_scenes(job: Job) -> None:
    """Render what the scenes of a job lack; those of a trial are fewer than those of the training
    that follows, in one folder.
    """
    build_data(job.cfg.data, job.cfg.console).render()


def measure(work: Onboarding, job: Job, began: float) -> None:
    """Measure the training, and say so where the budget does not hold the least of it.

    Args:
        work: What is to be done.
        job: The training, on frames that are rendered.
        began: When this stage did, by `time.perf_counter`.
    """
    say(work.cfg.console, "measuring", "measuring the time of a step and of an image")
    speed = measure_speed(job)
    work.stages.keep(
        seconds_per_step=speed.step,
        seconds_per_image=speed.image,
        measured_with=unresolved(work.cfg.get("train_overrides")),
    )
    spent = work.spent + time.perf_counter() - began
    least = spent + work.to_render + _FEWEST_STEPS * speed.step + work.rest(speed)
    if work.cfg.steps is None and least > work.budget:
        minutes = math.ceil(least / 6) / 10
        warn(
            work.cfg.console,
            f"budget_minutes={work.cfg.budget_minutes:g} is too short on this machine and will be "
            f"exceeded: {work.frames} frames, {_FEWEST_STEPS} training steps, calibration and test "
            f"take about {format_duration(least)}; the least that holds them: "
            f"budget_minutes={minutes:g} frames={work.frames}",
            seconds=least,
        )


def train(work: Onboarding) -> None:
    """Train for as many steps as fit, from where it was interrupted if it was."""
    values, console = work.stages.values, work.cfg.console
    if not work.has_checkpoint:
        values.pop("steps", None)  # of a start that came to nothing, maybe with other settings
    if values.get("steps") is None:
        began = time.perf_counter()
        if work.speed is None:  # rendered by an earlier version, or other settings since
            measure(work, work.job(work.out / ".trial"), began)
        assert work.speed is not None
        steps, seconds = work.plan(work.speed, work.spent + time.perf_counter() - began)
        work.stages.keep(steps=steps, seconds_per_step=seconds)
        duration = format_duration(steps * seconds)
        fixed = f"{steps} steps of {seconds:.2f} s each: {duration}"
        fitting = f"at most {steps} steps in {duration}"
        if steps == _FEWEST_STEPS:
            fitting = f"{steps} steps, the fewest that are trained: about {duration}"
        sentence = fixed if work.cfg.steps else fitting
        say(console, "steps", sentence, steps=steps, seconds_per_step=seconds)
    if work.cfg.steps is None:  # the machine may turn out slower than it was measured
        seconds = values["steps"] * values["seconds_per_step"]
        began = time.perf_counter()
        callbacks = work.run.trainer.callbacks  # built here, and the frames' list read: that counts
        seconds = max(seconds / 2, seconds - (time.perf_counter() - began))
        callbacks.append(TimeBudget(seconds, fewest=_FEWEST_STEPS))
    work.stages.keep(training=fit(work.run))


def choose_steps(room: float, step: float) -> tuple[int, float]:
    """Return how many steps a training is given at most, and how long one may take [s].

    Args:
        room: Time for all of them [s].
        step: How long one took when it was measured [s].
    """
    hoped = _HOPED * min(step, _SLOWEST)
    steps = min(_MOST_STEPS, max(_FEWEST_STEPS, int(room / hoped)))
    return steps, step if steps == _FEWEST_STEPS else room / steps


def export(work: Onboarding) -> None:
    """Write the weights that predict."""
    checkpoint = read_checkpoint(work.training / "checkpoints" / "best.ckpt")
    stripped = strip(checkpoint, points=_POINTS, quantize=True)
    write_weights(stripped, work.weights, max_mb=math.inf)


def calibrate(work: Onboarding) -> None:
    """Give the weights a probability, from validation scenes and from renders without the object;
    say so where there are too few.
    """
    if work.stages.seconds["calibrate"]:
        sentence = "the calibration was interrupted: its renders are kept, its estimates begin anew"
        say(work.cfg.console, "begins_anew", sentence)
    job = work.job(work.training, f"data.limit_val={_CALIBRATED}")
    data = build_data(job.cfg.data, work.cfg.console)
    data.setup("validate")
    count = len(data.val_dataset)
    if count < FEWEST:
        said = f"not calibrated: {count} validation frames, and {FEWEST} are needed"
        work.stages.keep(calibration=None)
        say(work.cfg.console, "calibrated", said, frames=count, calibrated=False)
        return
    settings = job.cfg.data
    OmegaConf.set_struct(settings, False)
    settings.generate.update(frames=count, absent_fraction=1.0, seed=int(work.cfg.seed) + 1)
    settings.root, settings.split = str(work.out / "absent"), {"val": 1.0}
    without = build_data(settings, work.cfg.console).absent_dataset("val", count)
    checkpoint = read_checkpoint(work.weights)
    method = method_of(checkpoint, lightning=False)
    method.to(choose_device())
    calibration = learn(method, data.val_dataset, [without], data.source, work.cfg.console)
    save_whole({**checkpoint, "calibration": calibration.to_plain()}, work.weights)
    work.stages.keep(calibration={"counts": calibration.counts, "quality": calibration.quality})


def evaluate(work: Onboarding) -> None:
    """Test the weights on held-out renders, with the second look that their calibration allows."""
    move_evaluation(work.training)  # which a user made in that folder
    tested_at = read_trained(read_checkpoint(work.run.best))
    training = {**work.stages.values["training"], "tested_step": tested_at.step}
    results = test(work.run, read_checkpoint(work.weights), tested_at)
    finish(work.run, training, results, work.weights)


def report(work: Onboarding) -> None:
    """Write the page."""
    record = read_run(work.training)
    page = make_onboarding_page(
        record,
        compared(record),
        typed("onboard", mesh=work.cfg.mesh, out=work.out),
        work.stages.values,
        work.stages.seconds,
        work.out / "symmetries.png",
    )
    write_page(page, work.out / "report")


def tell(work: Onboarding) -> None:
    """Say what came of it."""
    metrics = own_metrics(work.training)
    minutes = {name: s / 60 for name, s in work.stages.seconds.items()}
    files = {
        "weights": work.weights,
        "report": work.out / "report" / "report.html",
        "symmetries": work.out / "symmetries.png",
        "training": work.training,
    }
    shown = ", ".join(f"{name} {m:.1f}" for name, m in minutes.items())
    say(work.cfg.console, "minutes", f"minutes: {shown}", minutes=minutes)
    scores = {key: metrics[key] for key in ("add", "add_s", "mssd", "mspd")}
    following = [typed_prediction(work.weights)]
    ended(work.cfg.console, "onboarded", files, following, object=work.mesh.name, **scores)


def _split(frames: int) -> str:
    """Return the shares of the parts: enough to calibrate and to test, the rest to learn from."""
    val = round(min(0.1, _VAL_FRAMES / frames), 4)
    test = round(min(0.2, _TEST_FRAMES / frames), 4)
    return f"{{train: {1 - val - test:.4f}, val: {val}, test: {test}}}"


_DISTRACTORS = ("distractor_meshes", "distractor_scale")
_TRAINED = ("used", "frames", "budget_minutes", "steps", "warm_start", "train_overrides", "seed")
STAGES = (
    Stage("mesh", "checking the mesh", ("mesh", "name", *_DISTRACTORS), store_meshes),
    Stage("symmetries", "finding symmetries", ("mesh", "symmetries"), use_symmetries),
    Stage("render", "rendering", ("mesh", "name", *_DISTRACTORS, "seed", "frames"), render, True),
    Stage("train", "training", ("mesh", *_TRAINED), train, True),
    Stage("export", "writing the weights", ("mesh", *_TRAINED), export),
    Stage("calibrate", "calibrating the probability", ("mesh", *_TRAINED), calibrate),
    Stage("test", "testing on held-out renders", ("mesh", *_TRAINED, "test_frames"), evaluate),
    Stage("report", "writing the report", ("mesh", *_TRAINED, "test_frames"), report),
)
