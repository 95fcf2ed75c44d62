"""Old names of settings, typed or in a checkpoint, end in one line that names the new ones."""

from pathlib import Path

import pytest

from posefilter.cli import run_command
from posefilter.cli.choices import check_choices
from posefilter.cli.renamed import rename, rename_missing, update, upgrade
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]
RENAMED = {
    "initialise=uniform": "filter/initialize=uniform",
    "initialize=informed": "filter/initialize=informed",
    "reweigh=annealed": "filter/reweight=current_likelihood",
    "filter/reweight=tempered,sequential": "filter/reweight=likelihood_ratio,sequential_bayes",
    "filter/resample=transport": "filter/resample=optimal_transport_sampled",
    "filter/resample=ensemble": "filter/resample=optimal_transport",
    "filter/resample=guided": "filter/resample=auxiliary",
    "propose=still": "filter/propagate=identity",
    "schedule=pixels": "filter/schedule=pixels",
    "resample=never": "filter/resample=none",
    "resample=none,systematic": "filter/resample=none,systematic",
    "estimate=best": "filter/estimate=argmax",
    "refine=none": "filter/refine=none",
    "context=resnet34": "model/encoder=resnet model.encoder.trunk.kind=resnet34",
    "pose_code=fragments": "model/pose_head=fragments",
    "bounds=votes": "model/box_head=votes",
    "motion=held": "model/displacement=gated",
    "lesson=candidates": "model/candidate_sampler=poses",
    "proposals=none": "model/proposals=none",
    "train_filter=short": "model/train_rollout=short",
    "model/train_rollout=truncated": "model/train_rollout=short",
    "train_filter.steps=3": "model.train_rollout.steps=3",
    "model.train_filter.steps=3": "model.train_rollout.steps=3",
    "~model.train_filter.resample": "~model.train_rollout.resample",
    "motion_lesson=towards": "loss/aux/displacement=towards_object",
    "aux_displacement=center": (
        "loss/aux/displacement=towards_object "
        "model.aux_losses.displacement.loss.label.target=center"
    ),
    "likelihood_lesson=focal": "loss/aux/likelihood=focal",
    "pose_lesson=own_point": "loss/aux/pose=surface_point",
    "stages=three_motion": "loss/schedule=three_stages_displacement",
    "loss_schedule=only_likelihood": "loss/schedule=likelihood_only",
    "place_gradient=stopped": "model.detach_position=true",
    "place_gradient=flows": "model.detach_position=false",
    "model.place_gradient=true": "model.detach_position=false",
    "normalisation=batch": "model.net.normalization=batch",
    "net.width=16": "model.net.width=16",
    "net=latent": "model/net=latent",
    "glimpse=smooth": "model/glimpse=bilinear",
    "patch=6": "model.glimpse.size=6",
    "augment=whole": "data/augment=strong_full_image",
    "data/augment=camera_whole": "data/augment=camera_full_image",
    "model/pose_head=own_point": "model/pose_head=surface_point",
    "ablation=pose_c11_own_point": "ablation=pose_c11_surface_point",
    "resample.alpha=0.2": "filter.resample.alpha=0.2",
    "++estimate.bandwidth=0.1": "++filter.estimate.bandwidth=0.1",
    "filter=pose_paper": "filter=pose filter.particles=1000 filter.steps=100",
    "rung=c8_short": "ablation=c8_short",
    "ablation=c8_truncated": "ablation=c8_short",
    "ablation=s5_place": "ablation=s5_position",
    "deviation=patch_pf/paper": "preset=patch_pf/paper",
    "sweep=ladder": "sweep=ablation",
    "sweep=ablation_pose": "sweep=ablation_pose_pf",
    "experiment=memorise": "experiment=memorize",
    "console=plain": "console=json",
    "callbacks=none": "callbacks=checkpoints",
    "debug=trace": "debug=traceback",
    "model.relevance=0.5": "model.objectness_weight=0.5",
    "filter/initialize=from_relevance": "filter/initialize=from_objectness",
    "scheduler=warm_cosine": "scheduler=warmup_cosine",
    "loss=contrast": "loss=contrastive",
    "loss=bce,contrast": "loss=bce,contrastive",
    "model/box_head=spread": "model/box_head=quantiles",
    "tracker.follow.start=0.01": "tracker.follow.initial_sigma=0.01",
    "tracker.search.stop=0.01": "tracker.search.final_sigma=0.01",
    "tracker.look.points=32": "tracker.probe.pixels=32",
    "tracker.look.min_particles=64": "tracker.probe.min_particles=64",
    "tracker.look.final_sigma=0.01": "tracker.probe.final_sigma=0.01",
    "++tracker.look={steps:2}": "++tracker.probe={steps:2}",
    "tracker.look_every=3": "tracker.probe_every=3",
    "tracker.rounds=2": "tracker.quadratic_fits=2",
    "tracker.motion.momentum=0": "tracker.motion.velocity_gain=0",
    "tracker.motion.widest=1": "tracker.motion.max_noise_scale=1",
    "tracker.fit_points=32": "tracker.fit_pixels=32",
    "callbacks.figures.without=[animation]": "callbacks.figures.exclude=[animation]",
    "callbacks.figures.every=5": "callbacks.figures.every_n_validations=5",
    "most_mb=8": "max_mb=8",
    "compact=false": "quantize=false",
    "filter/propagate=gaussian_and_turns": "filter/propagate=gaussian_and_axis_rotations",
    "filter/refine=mean_shift_and_moves": "filter/refine=mean_shift_and_resample_move",
    "model.candidate_sampler.turns.probability=1": (
        "model.candidate_sampler.rotations.probability=1"
    ),
    "loss=belief_maps": "loss=heatmaps",
    "filter.first_particles=100": "filter.initial_particles=100",
    "filter.zoom_diameter=0.4": "filter.magnified_width=0.4",
    "++filter.zoom_diameter=null": "++filter.magnified_width=null",
    "model.train_filter.zoom_diameter=null": "model.train_rollout.magnified_width=null",
    "model.train_filter.first_particles=null": "model.train_rollout.initial_particles=null",
    "train_filter.first_particles=null": "model.train_rollout.initial_particles=null",
    "model.candidate_sampler.levels=4": "model.candidate_sampler.sigma_levels=4",
    "lesson.levels=4": "model.candidate_sampler.sigma_levels=4",
    "filter/resample=below_ess": "filter/resample=adaptive",
    "resample=below_ess,guided": "filter/resample=adaptive,auxiliary",
    "filter/resample@model.train_filter.resample=never": (
        "filter/resample@model.train_rollout.resample=none"
    ),
    "filter/resample@model.train_filter.resample=soft": (
        "filter/resample@model.train_rollout.resample=soft"
    ),
    "sweep=iterations": "sweep=steps",
    "tracker.walk=0.4": "tracker.noise_scale=0.4",
    "tracker.move_scale=0.4": "tracker.noise_scale=0.4",
    "tracker.cell=0.03": "tracker.kld_bin_size=0.03",
    "tracker.kld_cell=0.03": "tracker.kld_bin_size=0.03",
    "model/likelihood=contrastive": "model/likelihood=pointwise",
    "likelihood=contrastive,paper": "model/likelihood=pointwise,paper",
    "loss/aux/likelihood=balanced": "loss/aux/likelihood=balanced_bce",
    "loss/aux/displacement=towards": "loss/aux/displacement=towards_object",
    "model/glimpse=smooth": "model/glimpse=bilinear",
    "model/candidate_sampler=candidates": "model/candidate_sampler=poses",
    "data.points=500": "data.num_model_points=500",
    "data.model_points=models": "data.model_points_dir=models",
    "lookalike_texture=own": "lookalike_texture=same",
    "data.generate.lookalike_texture=other": "data.generate.lookalike_texture=different",
    "occlusion=0.5": "max_occlusion=0.5",
    "data.generate.occlusion=0.5": "data.generate.max_occlusion=0.5",
    "occluded_share=0.2": "occluded_fraction=0.2",
    "data.generate.tabletop_share=1": "data.generate.tabletop_fraction=1",
    "absent_share=1": "absent_fraction=1",
    "covered_frames=6": "fully_occluded_frames=6",
    "budget=patch_pf/working": "the preset, with its size apart: preset/size=patch_pf",
}

OF_COMMANDS = {
    "calibrate replace=true": "overwrite=true",
    "check_data limit=null": "max_frames=null",
    "convert_bag keep=true": "copy_messages=true",
    "convert_bag tolerance=0.02": "max_time_difference=0.02",
    "generate occlusion=0.5": "max_occlusion=0.5",
    "generate lookalike_texture=other": "lookalike_texture=different",
    "onboard settings=['filter.particles=200']": "train_overrides=['filter.particles=200']",
    "onboard clutter=DIR": "distractor_meshes=DIR",
    "onboard clutter_scale=0.001": "distractor_scale=0.001",
    "onboard symmetries=found": "symmetries=auto",
    "predict view=true": "save_rerun=true",
    "track view=true": "save_rerun=true",
    "track video=gif": "save_video=gif",
}


@pytest.mark.parametrize("typed", OF_COMMANDS)
def test_an_old_name_of_a_command_is_answered_by_it(
    typed: str, capfd: pytest.CaptureFixture[str]
) -> None:
    command, argument = typed.split(maxsplit=1)
    assert run_command(command, HOME, [argument]) == 2
    assert capfd.readouterr().err == f"{command}: {argument}: is now {OF_COMMANDS[typed]}\n"
    assert rename(OF_COMMANDS[typed], command) is None


def test_a_name_of_another_command_is_left_alone() -> None:
    assert rename("limit=3", "track") is None
    assert rename("data.options={keep: true}", "train") is None


@pytest.mark.parametrize("typed", RENAMED)
def test_an_old_name_is_answered_by_the_new_one(typed: str) -> None:
    with pytest.raises(UserError) as caught:
        check_choices([typed], HOME / "conf")
    assert str(caught.value) == f"{typed}: is now {RENAMED[typed]}"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("now", sorted({*RENAMED.values()} - {RENAMED["budget=patch_pf/working"]}))
def test_todays_names_are_left_alone(now: str) -> None:
    for typed in now.split():
        assert rename(typed) is None
        check_choices([typed], HOME / "conf")


def test_the_command_ends_in_that_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_command("train", HOME, [f"out={tmp_path}", "rung=c5_lesson"]) == 2
    said = capfd.readouterr().err
    assert said == "train: rung=c5_lesson: is now ablation=c5_displacement_loss\n"


@pytest.mark.parametrize(
    ("source", "name"),
    [("bop", "split"), ("fat", "part"), ("mine", "part")],  # FAT had `parts`
)
def test_options_of_readers_are_renamed_by_their_reader(source: str, name: str) -> None:
    """A reader of one's own may have an option of the same name."""
    settings = {
        "data": {
            "_target_": "posefilter.data.module.PoseDataModule",
            "source": source,
            "options": {"part": "x"},
        }
    }
    upgraded = upgrade({"choices": {}, "settings": settings})
    assert upgraded["settings"]["data"]["options"] == {name: "x"}
    assert rename("data.options.part=x") is None
    assert rename_missing("data.options.part") == "data.options.split"


@pytest.mark.parametrize(
    ("typed", "now"),
    [
        (["data=bop", "data.options.part=test"], "data.options.part: is now data.options.split"),
        (["model=rotation_grid", "model.reach=1"], "model.reach: is now model.crop_radius"),
    ],
)
def test_names_that_others_may_have_are_answered_where_they_are_missing(
    typed: list[str], now: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("train", HOME, [*typed, "data.root=/nonexistent"]) == 2
    assert capfd.readouterr().err.strip() == f"train: {now}"


def test_what_a_resumed_run_was_started_with_has_todays_names() -> None:
    recorded = ["filter.first_particles=32", "model/likelihood=contrastive", "seed=1"]
    assert [update(one, "train") for one in recorded] == [
        "filter.initial_particles=32",
        "model/likelihood=pointwise",
        "seed=1",
    ]
