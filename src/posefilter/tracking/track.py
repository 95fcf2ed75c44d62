"""One object, followed from frame to frame."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from posefilter.confidence.calibration import Assessment
from posefilter.confidence.features import measure_hidden
from posefilter.confidence.scale_ratio import ScaleRatio
from posefilter.confidence.tolerance import RIGHT, PoseTolerance
from posefilter.confidence.verdicts import Costs, Verdict
from posefilter.data.resize import network_size
from posefilter.filters.icp import PointToPlaneIcp
from posefilter.filters.loop import ParticleFilter, inherit, make_particles
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import Compose
from posefilter.filters.resample import Multinomial, Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Geometric
from posefilter.filters.texture import TextureRotations
from posefilter.geometry.pose import origin_of
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.images import Images
from posefilter.models.base import PoseEstimator
from posefilter.nets.pose_votes import has_depth
from posefilter.protocols import Refine
from posefilter.result import Result, Run, make_result
from posefilter.tracking.components import FromBelief, ModeMean, RotateTogether, smooth
from posefilter.tracking.fit import QuadraticFit
from posefilter.tracking.kld import bin_poses, count_needed
from posefilter.tracking.objectness import measure_objectness, measure_presence
from posefilter.tracking.scoring import FrameScorer, check_method
from posefilter.tracking.settings import FilterSettings, TrackerSettings
from posefilter.tracking.track_loss import LOST, TRACKED, TrackLossDetector
from posefilter.tracking.window import Frame, Window, place_window
from posefilter.types import Batch, BeliefBatch, Particles, Trace

_WIDE = 0.04  # [m] the highest level at which a tracked frame is measured
_MODE = 0.02  # [m] about the best particle, over which the estimate is a mean
# by how much errors of a track are larger than those of the calibrated filter, whose estimate is
# refined more: of five objects in rendered sequences
_WIDENING = 1.3
# what hides an object may hide that it is moved: half of what is known after 34 frames
_FADES = 0.98
_ICP_STEPS = 2  # a tracked estimate starts close: more cost a tenth of a frame's time


@dataclass(frozen=True, eq=False, repr=False)
class TrackResult(Result):
    """Where a tracked object is in a frame.

    Attributes:
        status: "started" where it is found for the first time, "tracked" from the frame before,
            "recovered" after a loss, or "lost": then the pose is no more than a guess.
        objectness: What the network says of the pixels that the object covers: the mean probability
            that they show it. Occlusion lowers it. It is not calibrated.
        particles: How many particles the next frame starts from.

    The belief is calibrated by what errors of single images taught, where the frame was measured.
    `presence` and `probability` are those of an estimate on a single image with the same features,
    lowered where a lost object would be elsewhere than where something covered it; a track is
    judged lost or recovered by the presence.  Where the presence is too low for the estimate to be
    trusted, they and the features are that estimate's, the pose is the predicted one, and the score
    is -inf.
    """

    status: str
    objectness: float
    particles: int

    @property
    def is_tracked(self) -> bool:
        """Whether the pose is one to go by: the object is not lost."""
        return self.status != LOST

    def decide(
        self, costs: Costs, pose_tolerance: PoseTolerance | None = None, prior: float = 0.5
    ) -> Verdict | None:
        """Return the verdict as of `Result`; an object that is lost is not found, since its pose is
        no more than a guess.
        """
        verdict = super().decide(costs, pose_tolerance, prior)
        return verdict if self.is_tracked or verdict != "found" else "unsure"

    def probability_within(self, pose_tolerance: PoseTolerance | None) -> float:
        """Return the probability as of `Result`, lowered as the presence was."""
        within = super().probability_within(pose_tolerance)
        if self.presence is None or pose_tolerance in (None, RIGHT):
            return within
        before = float(self._assess(RIGHT).presence)
        return within * min(1.0, self.presence / before) if before else 0.0

    @property
    def shown_pose(self) -> np.ndarray | None:
        """The pose as of `Result`; None where the object is lost."""
        return super().shown_pose if self.is_tracked else None

    def describe(self) -> str:
        """Return the verdict in a few words, as of `Result`; of a lost object that it is lost."""
        return super().describe() if self.is_tracked else f"{self.object}: lost"

    @property
    def _why_no_sets(self) -> str:
        return "their guarantee is of one search of the whole image, not of a track"


class Loss(NamedTuple):
    """How an object was lost from sight."""

    # the share of its surface before which something nearer was measured; None before a frame told
    hidden: float | None
    speed: float  # of its center in the last frame that showed it [m]
    frames: int = 0  # since then


class State(NamedTuple):
    """What is carried from one frame to the next."""

    belief: Particles  # of one image
    best: Tensor  # (1, 4, 4) the estimate, smoothed over time [m]
    velocity: Tensor  # (1, 6) its motion in the last frame [m, rad]
    squared_innovation: float | None  # fading mean; see `ConstantVelocity.adapt`
    loss: Loss | None = None  # None while it is seen


class TrackSnapshot(NamedTuple):
    """All that a track remembers, so that another process can go on with it: the generator's state,
    then attributes of `Track` by their names.
    """

    random: Tensor  # state of the generator
    state: State | None
    loss_detector: TrackLossDetector
    frames: int
    scale_ratio: ScaleRatio | None
    rotation_margin: Tensor | None


class FrameEstimate(NamedTuple):
    """What one frame shows."""

    batch: Batch  # the image, or the window of it that was looked at
    belief: BeliefBatch | None = None  # None where nothing has depth, or it cannot be judged
    objectness: float = 0.0  # the mean objectness of the pixels that the estimate covers
    presence: float = 0.0  # what the track is judged by
    found: Assessment | None = None  # the calibrated probabilities
    size: ScaleRatio | None = None  # where it was measured


class Track:
    """Follow one object.

    Args:
        method: The object's trained filter.
        size: Width and height of the images that it was trained on [px]; None where they follow
            the image's.
        settings: Of the tracker.
        seed: Decides every random draw.
        phase: Frames by which the whole image, and the probes and searches while it is lost, come
            sooner: objects that are tracked together take turns.
        multi_object: Whether other objects are tracked, too: while it is lost, only every
            `probe_every`-th frame is then probed for it.
        costs: What errors cost, which the results' verdicts go by; None: the default.
        pose_tolerance: What a right pose is, likewise; None: an ADD below 0.1 diameters.

    Raises:
        UserError: The method cannot be tracked with.
    """

    def __init__(
        self,
        method: PoseEstimator,
        size: tuple[int | None, int | None],
        settings: TrackerSettings,
        seed: int = 0,
        phase: int = 0,
        multi_object: bool = False,
        costs: Costs | None = None,
        pose_tolerance: PoseTolerance | None = None,
    ) -> None:
        check_method(method)
        assert isinstance(method.space, PoseSpace)
        self.method, self.space = method, method.space
        self.size, self.settings, self.seed, self.phase = size, settings, seed, phase
        self.multi_object = multi_object
        self.costs, self.pose_tolerance = costs, pose_tolerance
        self.reset()

    def reset(self) -> None:
        """Forget the object: the next frame is the first."""
        seed = self.seed % (1 << 63)
        self.generator = torch.Generator(device=self.method.device).manual_seed(seed)
        self.state: State | None = None
        self.loss_detector = TrackLossDetector(self.settings)
        self.frames = 0
        self.scale_ratio: ScaleRatio | None = None  # as last measured
        self.rotation_margin: Tensor | None = None  # likewise, (1,)

    @property
    def snapshot(self) -> TrackSnapshot:
        """What the next frame depends on."""
        others = (getattr(self, name) for name in TrackSnapshot._fields[1:])
        return TrackSnapshot(self.generator.get_state(), *others)

    @snapshot.setter
    def snapshot(self, snapshot: TrackSnapshot) -> None:
        self.generator.set_state(snapshot.random)
        for name in TrackSnapshot._fields[1:]:
            setattr(self, name, getattr(snapshot, name))

    @property
    def estimated_cost(self) -> float:
        """About what the next frame will cost, in frames that are tracked in a window."""
        if self.state is None:
            return 8.0
        if self.loss_detector.lost:
            return 0.2 if self._rests else 2.5 if self._search_is_due else 1.0
        return 1.5 if self._whole_is_due else 1.0

    @torch.no_grad()
    def update(self, frame: Frame) -> TrackResult:
        """Return where the object is in the next frame."""
        start = time.perf_counter()
        self.method.seed = self.seed  # others may use the method too, with seeds of their own
        predicted = None if self.state is None else self._predict(self.state)
        lost, rests, window = self.loss_detector.lost, self._rests, None
        if predicted is not None and not lost:
            window = self._choose_window(frame.images, predicted)
        seen = frame.see_whole(self.size) if window is None else frame.see_window(window)
        batch = Batch(*(x.to(self.method.device) for x in seen))
        if rests or frame.blank or not bool(has_depth(batch).all()):
            sight = FrameEstimate(batch)
        elif predicted is None:
            sight = self._estimate(batch)
        elif lost:
            sight = self._search(batch, predicted)
        else:
            sight = self._follow(batch, predicted, windowed=window is not None)
        if predicted is not None and self.loss_detector.ever_tracked:
            if lost:
                sight = self._doubt_elsewhere(sight, predicted)
            if lost or sight.presence < self.settings.lost_below:
                predicted = self._look_behind(predicted, sight)
        trusted, status = self.loss_detector.judge(sight.presence)
        self.scale_ratio = self.scale_ratio if sight.size is None else sight.size
        if sight.found is not None and sight.found.features is not None:
            self.rotation_margin = sight.found.features.get("rotation_margin")
        if status != LOST and sight.belief is not None:
            # inputs that are wrong stay so in frames that do not measure it
            sight = sight._replace(size=self.scale_ratio)
        belief = sight.belief if trusted or predicted is None else None
        self.state = self._correct(predicted, belief, status)
        self.frames += 1
        run = self._describe(sight, frame.blank, measured=belief is not None and status != LOST)
        run = run._replace(photograph=frame.shrink(self.size))
        result = make_result(run, 0, self.costs, self.pose_tolerance)
        # the guarantee of conformal sets is of the filter that was calibrated, no track's
        content = {**vars(result), "seconds": time.perf_counter() - start, "conformal": None}
        if rests and not frame.blank and self.method.calibration is not None:
            content["calibration_note"] = "the object is lost, and was not probed for in this frame"
        count = 0 if self.state is None else self.state.belief.state.shape[1]
        return TrackResult(**content, status=status, objectness=sight.objectness, particles=count)

    # -- the steps of a frame ---------------------------------------------------------------------

    def _predict(self, state: State) -> State:
        """Return where the object is expected: draws of the moved belief, of equal weight, as many
        as KLD sampling calls for.
        """
        settings, motion = self.settings, self.settings.motion
        wanted = settings.probe if self.loss_detector.lost else settings.follow
        drift = motion.expect(state.velocity)
        expected = self.space.move(state.best, drift)
        scale = motion.noise_scale(state.squared_innovation)
        drawn = Multinomial()(state.belief, wanted.max_particles, self.space, self.generator)
        draws = motion(inherit(state.belief.state, drawn), drift, scale, self.space, self.generator)
        cells = bin_poses(draws[0], expected[0], self.space, settings.kld_bin_size)
        least, epsilon, quantile = wanted.min_particles, settings.kld_epsilon, settings.kld_quantile
        count = count_needed(cells, epsilon, quantile, least)
        return state._replace(belief=make_particles(draws[:, :count], 0), best=expected)

    def _estimate(self, batch: Batch) -> FrameEstimate:
        """Run the estimator's own filter on the whole image."""
        trace = self.method.predict_step(batch, 0)
        size = self.method.measure_scale_ratio(trace, batch)
        return self._weigh(batch, trace, with_margin=True)._replace(size=size)

    def _follow(self, batch: Batch, predicted: State, windowed: bool) -> FrameEstimate:
        """Run a filter of few particles from the predicted belief."""
        settings, follow = self.settings, self.settings.follow
        scale = settings.motion.noise_scale(predicted.squared_innovation)
        against = settings.jump_penalty
        if scale > 1:
            # from wide levels down; what the network proposes gains on a prior that is thinner
            # by the scale in each of six dimensions
            steps = follow.steps + math.ceil(math.log(scale, 4))
            level = max(follow.initial_sigma, min(_WIDE, scale * follow.initial_sigma))
            proposals = 3 * follow.proposals
            follow = replace(follow, steps=steps, initial_sigma=level, proposals=proposals)
            against = max(0.0, against - 6 * math.log(scale))
        elif windowed:  # what it shows is the predicted belief's already
            follow = replace(follow, proposals=0)
        encoding, start = self.method.encode(batch), predicted.belief.state
        turns = [RotateTogether(one) for one in self._texture_rotations if self._texture_is_due]
        refine = self._refine(settings.quadratic_fits, turns)
        due = self._margin_is_due
        found, trace = self._filter(batch, encoding, start, follow, refine, against, due)
        if not windowed and self._size_is_open:
            size = self.method.measure_scale_ratio(trace, batch)
            if size is not None and bool(size.scale.isfinite().all()):
                return found._replace(size=size)
        return found

    def _search(self, batch: Batch, predicted: State) -> FrameEstimate:
        """Probe the whole image for a lost object, and search where that is worth it."""
        settings, encoding = self.settings, self.method.encode(batch)
        start = predicted.belief.state
        probed, _ = self._filter(batch, encoding, start, settings.probe, self._refine(0))
        if probed.presence < settings.search_above and not self._search_is_due:
            return probed
        assert probed.belief is not None
        begun, search = begin(probed.belief).belief, settings.search
        drawn = Multinomial()(begun, search.min_particles, self.space, self.generator)
        start = inherit(begun.state, drawn)
        # as in a single image: the frame before does not tell how the object is turned
        refine = self._refine(settings.quadratic_fits, self._texture_rotations)
        found, trace = self._filter(batch, encoding, start, search, refine, with_margin=True)
        return found._replace(size=self.method.measure_scale_ratio(trace, batch))

    def _look_behind(self, predicted: State, sight: FrameEstimate) -> State:
        """Return the state of an object that is not seen, with how it was lost from sight.

        That is not measured again: a camera that moves sees another place where the object was
        last.
        """
        loss = predicted.loss or Loss(None, float(predicted.velocity[0, :3].norm()), -1)
        loss = loss._replace(frames=loss.frames + 1)
        if loss.hidden is None and sight.belief is not None:
            hidden = measure_hidden(predicted.best, sight.batch, self.method.object_model)
            loss = loss._replace(hidden=float(hidden))
        return predicted._replace(loss=loss)

    def _doubt_elsewhere(self, sight: FrameEstimate, predicted: State) -> FrameEstimate:
        """Return what a frame shows of a lost object, less probable where it is elsewhere.

        An object that was lost behind something is probably still there, or not farther than it
        has moved since, and what resembles it elsewhere another.
        """
        loss, model = predicted.loss, self.method.object_model
        if loss is None or loss.hidden is None or sight.belief is None:
            return sight
        if not 0 < sight.presence < 1:  # no odds move a certainty
            return sight
        found, last = (
            origin_of(pose, model.center.to(pose)) for pose in (sight.belief.best, predicted.best)
        )
        if float((found - last).norm()) < model.diameter + loss.frames * loss.speed:
            return sight
        against = self.settings.elsewhere_penalty * loss.hidden * _FADES**loss.frames
        log_odds = math.log(sight.presence) - math.log1p(-sight.presence) - against
        presence = 1 / (1 + math.exp(min(-log_odds, 700.0)))
        judged = sight.found
        if judged is not None:
            probability = judged.probability * (presence / sight.presence)
            same = torch.full_like(judged.presence, presence)
            judged = judged._replace(presence=same, probability=probability)
        return sight._replace(presence=presence, found=judged)

    def _filter(
        self,
        batch: Batch,
        encoding: Any,
        start: Tensor,
        filter_settings: FilterSettings,
        refine: Refine,
        against: float = 0.0,
        with_margin: bool = False,
    ) -> tuple[FrameEstimate, Trace]:
        """Run a filter from poses (1, N, 4, 4), and proposals with log odds `against` them; see
        `_weigh`.
        """
        particles = min(start.shape[1], 2 * filter_settings.min_particles)
        filter = ParticleFilter(
            particles=particles,  # after the first step
            steps=filter_settings.steps,
            initialize=FromBelief(start, filter_settings.proposals),
            schedule=Geometric(filter_settings.initial_sigma, filter_settings.final_sigma),
            reweight=CurrentLikelihood(),
            resample=Systematic(),
            propagate=Gaussian(self.settings.noise_scale),
            estimate=ModeMean(_MODE),
            refine=refine,
        )
        pixels, proposals = filter_settings.pixels, filter_settings.proposals
        scorer = FrameScorer(self.method, encoding, pixels, proposals, against)
        trace = filter(batch, scorer, self.generator)
        return self._weigh(batch, trace, with_margin), trace

    def _refine(self, quadratic_fits: int, turns: Sequence[Refine] = ()) -> Refine:
        """Return what improves a frame's estimate: the likelihood, then the measured depth, then
        `turns` by the texture.
        """
        parts: list[Refine] = [QuadraticFit(quadratic_fits, pixels=self.settings.fit_pixels)]
        prior = self.settings.icp_prior
        if prior and "depth" in self.method.capabilities:
            aligned = [one for one in self._own_refine if isinstance(one, PointToPlaneIcp)]
            noise = (aligned or [PointToPlaneIcp()])[0].noise
            parts.append(PointToPlaneIcp(iterations=_ICP_STEPS, prior=prior, noise=noise))
        return Compose([*parts, *turns])

    @property
    def _own_refine(self) -> Sequence[Refine]:
        """What refines estimates of single images: its settings were chosen for the object."""
        own = self.method.filter.refine
        return getattr(own, "components", (own,))

    @property
    def _texture_rotations(self) -> list[TextureRotations]:
        return [one for one in self._own_refine if isinstance(one, TextureRotations)]

    def _correct(
        self, predicted: State | None, belief: BeliefBatch | None, status: str
    ) -> State | None:
        """Return the state after a frame; `belief` is None where what it shows is not trusted.

        It is None until a frame shows something: the next one is then the first.
        """
        motion = self.settings.motion
        if belief is None:
            if predicted is None:
                return None
            # what is hidden must not be searched for all over the image, by a track's low bar
            still = torch.zeros_like(predicted.velocity)
            return predicted._replace(velocity=still, squared_innovation=0.0)
        begun = begin(belief)
        if predicted is None or self.state is None or status != TRACKED:
            return begun
        center = belief.best.new_tensor(self.space.center)
        innovation = twist_between(predicted.best, belief.best, center)
        if motion.is_jump(innovation, predicted.squared_innovation):
            return begun
        best = smooth(predicted.best, belief.best, self.space, self.settings.smoothing_noise)
        return begun._replace(
            best=best,
            velocity=twist_between(self.state.best, best, center),
            squared_innovation=motion.adapt(predicted.squared_innovation, innovation),
        )

    # -- what is looked at, and what it says ------------------------------------------------------

    @property
    def _probes(self) -> tuple[int, bool]:
        """How often a probe would have been due, and whether one is due now."""
        every = self.settings.probe_every if self.multi_object else 1
        number, left = divmod(self.frames + self.phase, every)
        return number, left == 0

    @property
    def _rests(self) -> bool:
        return self.state is not None and self.loss_detector.lost and not self._probes[1]

    @property
    def _search_is_due(self) -> bool:
        every = self.settings.search_every
        return every > 0 and self._probes[0] % every == 0

    @property
    def _size_is_open(self) -> bool:
        """Whether the scale ratio is to be measured anew: too little of the object was seen, or the
        inputs were wrong, and may be right now.
        """
        ratio = self.scale_ratio
        return ratio is not None and bool((ratio.scale.isnan() | ratio.contradicts()).any())

    @property
    def _whole_is_due(self) -> bool:
        every = self.settings.whole_image_every
        # what a window leaves in doubt the whole image may tell
        due = every > 0 and (self.frames + self.phase) % every == 0
        return not self.loss_detector.sure or due

    @property
    def _texture_is_due(self) -> bool:
        every = self.settings.texture_every
        # not in the frames that see the whole image, which cost more anyway
        return every > 0 and (self.frames + self.phase) % every == every // 4

    @property
    def _margin_is_due(self) -> bool:
        """Whether the rotation's margin is measured, which of a can costs as much as a frame."""
        every = self.settings.texture_every or TrackerSettings.texture_every
        # after every other turn by the texture
        return (self.frames + self.phase) % (2 * every) == every // 4

    def _choose_window(self, images: Images, predicted: State) -> Window | None:
        """Return the window about the object; None where it is time for the whole image."""
        settings = self.settings
        height, width = images.depth.shape[1:]
        if self._whole_is_due:
            return None
        motion = settings.motion
        more = 2 * (motion.noise_scale(predicted.squared_innovation) - 1) * max(motion.scale[:3])
        return place_window(
            predicted.best[0].double().cpu().numpy(),
            self.method.object_model,
            images.intrinsics[0],
            (height, width),
            network_size(height, width, *self.size)[1] / width,
            settings.window_side,
            settings.window_scale + more / self.space.radius,
        )

    def _weigh(self, batch: Batch, trace: Trace, with_margin: bool) -> FrameEstimate:
        """Return what a frame shows, and whether the object is where the estimate puts it.

        The rotation's margin is measured with it, or is that of an earlier frame.
        """
        belief, points = trace.belief, self.method.object_model.points
        objectness = measure_objectness(trace.encoding.objectness, batch, belief.best[0], points)
        margin = None if with_margin else self.rotation_margin
        presence, found = measure_presence(self.method, trace, batch, objectness, margin)
        return FrameEstimate(batch, belief, objectness, presence, found)

    def _describe(self, sight: FrameEstimate, blank: str, measured: bool) -> Run:
        """Return the state as an estimator's run on what was looked at.

        Where the state is not `measured`, its belief is the predicted one, of which the calibration
        knows nothing.
        """
        state, draws = self.state, None
        if state is None:  # no more than a guess: a meter ahead
            ahead = torch.eye(4, device=self.method.device)
            center = self.method.object_model.center.to(ahead)
            ahead[:3, 3] = ahead.new_tensor([0.0, 0.0, 1.0]) - center
            one, zero = ahead[None], ahead.new_zeros(1)
            state = begin(BeliefBatch(one[None], zero[None], one, zero))
        score = state.best.new_full((1,), -torch.inf)
        score = sight.belief.score if measured and sight.belief is not None else score
        belief = BeliefBatch(state.belief.state, state.belief.log_weights, state.best, score)
        if measured:
            belief, draws = self.method.calibrate_belief(belief, sight.found, _WIDENING)
        trace = Trace((), (), (), belief)
        return Run(self.method, sight.batch, trace, 0.0, sight.found, sight.size, [blank], draws)


def begin(belief: BeliefBatch) -> State:
    """Return the state of a belief whose motion is not known."""
    particles = make_particles(belief.poses, 0)._replace(log_weights=belief.log_weights)
    still = belief.best.new_zeros(1, 6)
    return State(particles, belief.best, still, None)
