"""Tables of the names that settings, choices, classes and their arguments had before today's.

Each line of a table is a place, or several, and the names in it, `place, place: old > new, old >
new`; what is indented goes on with it.  `renamed.py` reads them.
"""


def _read(table: str) -> dict[str, dict[str, str]]:
    """Return a table's places, with today's names by those of before."""
    lines = [line.split(": ", 1) for line in table.strip().replace("\n    ", " ").splitlines()]
    return {
        place: dict(pair.split(" > ") for pair in names.split(", "))
        for places, names in lines
        for place in places.split(", ")
    }


def _join(places: dict[str, dict[str, str]]) -> dict[str, str]:
    """Return today's whole keys by those of before."""
    return {
        f"{place}.{old}": f"{place}.{new}"
        for place, names in places.items()
        for old, new in names.items()
    }


_RENDERED = """occlusion > max_occlusion, occluded_share > occluded_fraction,
    tabletop_share > tabletop_fraction, absent_share > absent_fraction,
    covered_frames > fully_occluded_frames"""  # of rendering, wherever it is set
# groups whose choices, and settings, are found elsewhere: by today's name, those of before
_GROUPS = """
filter/initialize: initialise initialize
filter/schedule: schedule
filter/reweight: reweigh reweight
filter/resample: resample
filter/propagate: propose propagate
filter/estimate: estimate
filter/refine: refine
model/encoder: context encoder
model/glimpse: glimpse
model/net: net
model/pose_head: pose_code pose_head
model/box_head: bounds box_head
model/displacement: motion displacement
model/likelihood: likelihood
model/proposals: proposals
model/candidate_sampler: lesson candidate_sampler
model/train_rollout: train_filter
loss/aux/displacement: motion_lesson aux_displacement
loss/aux/likelihood: likelihood_lesson aux_likelihood
loss/aux/pose: pose_lesson aux_pose
loss/schedule: stages loss_schedule
data/augment: augment
ablation: rung
preset: deviation
"""
GROUPS = {
    old: new
    for new, before in (line.split(": ") for line in _GROUPS.strip().splitlines())
    for old in before.split()
}
# groups and settings that are one setting now
KEYS = {
    "normalisation": "model.net.normalization",
    "normalization": "model.net.normalization",
    "place_gradient": "model.detach_position",
    "patch": "model.glimpse.size",
    "lessons": "model.aux_losses",
    "aux_losses": "model.aux_losses",
    "most_mb": "max_mb",
    "compact": "quantize",
    **_join(
        _read(f"""
model: place_gradient > detach_position, relevance > objectness_weight, train_filter > train_rollout
callbacks.figures: every > every_n_validations, without > exclude
model.candidate_sampler: turns > rotations, levels > sigma_levels
data: points > num_model_points, model_points > model_points_dir
data.generate: {_RENDERED}
filter: looks > max_searches, first_particles > initial_particles,
    zoom_diameter > magnified_width
model.train_rollout: first_particles > initial_particles, zoom_diameter > magnified_width
tracker: walk > noise_scale, move_scale > noise_scale, kld_cell > kld_bin_size,
    jump > jump_penalty, epsilon > kld_epsilon, quantile > kld_quantile, cell > kld_bin_size,
    look_around > whole_image_every, side > window_side, reach > window_scale,
    noise > smoothing_noise, full_every > search_every, full_search_every > search_every,
    fit_points > fit_pixels, rounds > quadratic_fits, look_every > probe_every, look > probe,
    look.start > probe.initial_sigma, look.stop > probe.final_sigma, look.points > probe.pixels
tracker.motion: shift_mm > translation_mm, turn_deg > rotation_deg, momentum > velocity_gain,
    widest > max_noise_scale
tracker.follow, tracker.search: least > min_particles, most > max_particles, start > initial_sigma,
    stop > final_sigma, points > pixels
""")
    ),
}
# settings of single commands
COMMANDS = _read(f"""
calibrate: replace > overwrite
check_data: limit > max_frames
convert_bag: keep > copy_messages, tolerance > max_time_difference
generate: {_RENDERED}
onboard: settings > train_overrides, clutter > distractor_meshes, clutter_scale > distractor_scale
predict: view > save_rerun
track: video > save_video, view > save_rerun
""")
# choices of groups, and values of settings
CHOICES = _read("""
filter: pose_paper > pose filter.particles=1000 filter.steps=100
filter/estimate: best > argmax
filter/initialize: from_relevance > from_objectness
symmetries: found > auto
scheduler: warm_cosine > warmup_cosine
loss: contrast > contrastive, belief_maps > heatmaps
model/box_head: spread > quantiles
filter/resample: never > none, below_ess > adaptive, transport > optimal_transport_sampled,
    ensemble > optimal_transport, guided > auxiliary
filter/reweight: annealed > current_likelihood, tempered > likelihood_ratio,
    sequential > sequential_bayes
filter/propagate: still > identity, gaussian_and_turns > gaussian_and_axis_rotations
filter/refine: mean_shift_and_moves > mean_shift_and_resample_move
model/displacement: held > gated
model/encoder: resnet18 > resnet model.encoder.trunk.kind=resnet18,
    resnet34 > resnet model.encoder.trunk.kind=resnet34
model/train_rollout: same > full, truncated > short
model/glimpse: smooth > bilinear
model/likelihood: contrastive > pointwise
model/candidate_sampler: candidates > poses
loss/aux/likelihood: balanced > balanced_bce
loss/aux/displacement: towards > towards_object,
    center > towards_object model.aux_losses.displacement.loss.label.target=center
loss/aux/pose: own_point > surface_point
model/pose_head: own_point > surface_point
data/augment: whole > strong_full_image, camera_whole > camera_full_image
loss/schedule: three > three_stages, three_motion > three_stages_displacement,
    only_motion > displacement_only, only_likelihood > likelihood_only
model.detach_position: flows > false, stopped > true, true > false, false > true
lookalike_texture, data.generate.lookalike_texture: other > different, own > same
experiment: memorise > memorize
console: plain > json
callbacks: none > checkpoints
debug: trace > traceback
sweep: ablation_pose > ablation_pose_pf, ladder > ablation, ladder_detect > ablation_detect,
    iterations > steps
ablation: s4_lesson > s4_displacement_loss, s5_place > s5_position,
    s9_lesson_and_place > s9_displacement_loss_and_position, c1_normalisation > c1_normalization,
    c5_lesson > c5_displacement_loss, c6_place > c6_position, c8_truncated > c8_short,
    pose_c11_own_point > pose_c11_surface_point, pose_m14_own_point > pose_m14_surface_point,
    pose_c16_held > pose_c16_gated, box_c12_held > box_c12_gated,
    m1_normalisation > m1_normalization, m5_lesson > m5_displacement_loss, m6_place > m6_position,
    m8_truncated > m8_short, m12_held > m12_gated, m13_rate > m13_scheduler
""")
# classes, by their place below posefilter
CLASSES = _join(
    _read("""
data.augmentation: Window > RandomCrop, Blank > RandomErasing, Color > ColorJitter
filters: guided.Guided > auxiliary.AuxiliaryResampling
filters.initialize: FromRelevance > FromObjectness
filters.propagate: AxisTurns > AxisRotations, HalfTurns > HalfTurnRotations, Chain > Compose
filters.refine: Chain > Compose
filters.resample: BelowESS > AdaptiveResampling
filters.reweight: Annealed > CurrentLikelihood, Sequential > SequentialBayes,
    TemperedSMC > LikelihoodRatio
filters.texture: TextureTurns > TextureRotations
filters.transport: Ensemble > EnsembleTransform, OptimalTransport > SampledTransport
losses: belief_maps.BeliefMaps > heatmaps.Heatmaps, contrast.Contrast > contrastive.Contrastive
models: schedules.warm_cosine > lr_schedulers.warmup_cosine,
    schedules.warmup_cosine > lr_schedulers.warmup_cosine
models.box_heads: SpreadBox > QuantileBox
nets: belief_maps.BeliefMapNet > heatmaps.HeatmapNet, context.NoContext > encoders.NoEncoder,
    context.Pyramid > encoders.PyramidEncoder, context.ConvEncoder > encoders.UNetEncoder,
    context.ResNetContext > encoders.ResNetEncoder
nets.glimpse: SmoothGlimpse > BilinearGlimpse
""")
)
# arguments of classes, by today's place of the class below posefilter
ARGUMENTS = _read(f"""
filters.loop.ParticleFilter: looks > max_searches, first_particles > initial_particles,
    zoom_diameter > magnified_width
filters.propagate.Compose, filters.refine.Compose: pieces > components
filters.propagate.Gaussian: factor > noise_scale
filters.propagate.HalfTurnRotations: share > probability
filters.propagate.AxisRotations: share > probability, any_angle > uniform_angle_probability
filters.refine.Rescore: top > top_k
filters.refine.MeanShift: rounds > iterations, pairs > antithetic_pairs, start > initial_scale,
    end > final_scale
filters.resample_move.ResampleMove: turn_probability > rotation_probability
filters.schedule.Geometric: start > initial_sigma, stop > final_sigma
filters.agreement.Agreement: rounds > iterations, options > top_fragments,
    counts > effective_particles
filters.initialize.FromDepth: behind > depth_offset
filters.initialize.FromObjectness: anywhere > uniform_fraction
filters.initialize.Informed: otherwise > initializer, share > object_fraction, around_px > sigma_px
models.candidate_samplers.CandidatePoses: each > candidates_per_kind, turns > rotations,
    levels > sigma_levels, proposed > proposals, own_level > persistent_sigma_probability,
    sigma > sigma_range, start > initial_sigma
models.candidate_samplers.LabeledRays: past > margin_behind, start > min_depth
models.box_heads.QuantileBox: beyond > quantile
models.base.PoseEstimator: train_filter > train_rollout
models.cnn_patch.CnnPatch, models.downsized.Downsized, models.patch_pf.PatchPF,
    models.pixel_pf.PixelPF: relevance > objectness_weight, relevance_weight > objectness_weight
models.pose_pf.PosePF: even_points > quasi_monte_carlo
models.rotation_grid.RotationGrid: reach > crop_radius
models.loss_schedule.Stage: factors > loss_weights
models.muon.Muon: spared > adam_layers
models.lr_schedulers.warmup_cosine: warm_up > warmup_steps, floor > min_lr_fraction
nets.encoders.UNetEncoder: most_px > max_width_px
nets.heads.Bounded: reach > max_displacement
nets.mlp.LatentNet: displacement_reads > displacement_input
labels.displacement.TowardsObject: reach > max_displacement
nets.paper_likelihood.PaperLikelihood: about > anchor
losses.displacement.Chamfer, losses.rgbd_chamfer.RgbdChamfer: most > max_pixels
losses.pose_loss.SurfacePointLoss: within > offset_weight
labels.paper_points.PaperPoints: on > surface_label, behind > behind_label
data.module.PoseDataModule: points > num_model_points, model_points > model_points_dir
synthetic.generate.generate: {_RENDERED}
data.augmentation.RollAndZoom: about > pivot, any_roll > uniform_roll_probability
data.augmentation.RandomCrop: anywhere > uniform_probability
data.augmentation.RandomErasing: most > max_rectangles
callbacks.health.FilterHealth: most > max_iterations, share > max_time_fraction
callbacks.diagnostics.Diagnostics, callbacks.figures.Figures: share > max_time_fraction
""")
# base classes, by the setting that holds one of them: one's own class there has their arguments too
BASES = {
    "model": "models.base.PoseEstimator",
    "filter": "filters.loop.ParticleFilter",
    "train_rollout": "filters.loop.ParticleFilter",
}
# values of arguments of classes, likewise
VALUES = {("synthetic.generate.generate", "lookalike_texture"): CHOICES["lookalike_texture"]}
# options of the data module, by the reader that takes them
OPTIONS = _read("""
bop: part > split
fat, scenes, ycb_video: parts > subsets
""")
