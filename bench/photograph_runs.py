"""The trainings behind docs/results/photographs.md, in the order in which they were made."""

from typing import NamedTuple

CRACKER = "weights/003_cracker_box.ckpt"
# by what the names of runs begin with; the seed of an object's scenes is its place
OBJECTS = {
    "drill": "035_power_drill", "soup": "005_tomato_soup_can", "sugar": "004_sugar_box",
    "mustard": "006_mustard_bottle", "foam": "061_foam_brick", "mug": "025_mug",
    "tuna": "007_tuna_fish_can", "meat": "010_potted_meat_can", "banana": "011_banana",
    "chef": "002_master_chef_can", "bowl": "024_bowl", "hammer": "048_hammer",
    "gelatin": "009_gelatin_box", "cracker": "003_cracker_box",
}  # fmt: skip
TARGETS = tuple(OBJECTS.values())
CLUTTER = ("021_bleach_cleanser", "052_extra_large_clamp")
_STEPS = "data.augment.steps"


def _color(label: int) -> str:
    """Return the colors of camera before it made the object bright; `label`: its step of labels."""
    after = f"{_STEPS}.{label + 4}.gain=0.2 {_STEPS}.{label + 4}.probability=0.3"
    return f"{_STEPS}.{label + 1}.probability=0.5 {after}"


def _plain(label: int) -> str:
    """Return the colors of camera before it stuck labels on the object."""
    return f"{_STEPS}.{label}.probability=0 {_STEPS}.{label + 1}.gain=[1,1] {_color(label)}"


# what camera did not do at first: labels and bright objects, bright objects alone, magnification
PLAIN, DIM = _plain(4), f"{_STEPS}.5.gain=[0.8,1.3] {_color(4)}"
FAR = f"{_STEPS}.1.pivot=center {_STEPS}.1.zoom=[0.75,1.3]"
NEAR = f"{_STEPS}.1.zoom=[0.7,2.2]"
SPLIT = "data.split={train: 0.8, val: 0.05, test: 0.15}"
# a third set of scenes, to learn from alone: tests are on those held out of the second
THIRD, TRAIN_SPLIT = "data_third", "data.split={train: 0.93, val: 0.05, test: 0.02}"
# a fourth, likewise, whose look-alikes of the target have another texture than it
FOURTH = "data_fourth"
# a fifth, of other seeds
FIFTH = "data_fifth"
# a sixth, of few objects and more frames of each: the seed, the frames, and the steps of each
SIXTH = "data_sixth"
SIXTH_SPLIT = "data.split={train: 0.96, val: 0.02, test: 0.02}"
SIXTH_RUNS = {
    "mustard": (2006, 2800, 7000), "tuna": (2007, 2800, 7000),
    "chef": (2002, 2800, 7000), "gelatin": (2009, 2800, 6000),
    "drill": (2035, 2800, 7000), "banana": (2011, 2800, 7000),
    "meat": (2010, 2800, 7000), "soup": (2005, 2800, 7000), "mug": (2025, 2800, 7000),
    "hammer": (2048, 2800, 6000), "sugar": (2004, 2800, 7000), "bowl": (2024, 2800, 7000),
}  # fmt: skip


class Run(NamedTuple):
    """A training: its name, its object, its method, the steps, what else is typed, and the folder
    of its scenes.
    """

    name: str
    object: str
    model: str
    steps: int
    words: str = ""
    scenes: str = "data"


def plan() -> list[Run]:
    """Return all trainings; a warm start follows the run that it starts from.

    `data/augment=camera` grew while they were made: it then magnified the object, stuck labels on
    it, and made it brighter. PLAIN, DIM, FAR and NEAR put back what a run did not have. DIM's
    brightness was normal in the logarithm, which is no choice any more; this is the nearest.
    """
    whole = f"data/augment=camera_full_image {_plain(3)}"
    after_drill = f"{whole} {_after(_best('drill_patch_camera'))}"
    short = "data/augment=camera data.limit_val=2 data.limit_test=2"
    first = f"{PLAIN} {FAR}"
    pair = f"{first} data.limit_val=4 data.limit_test=20 {_after(CRACKER)}"
    few = f"{short} {first} {_after(CRACKER)}"
    strong = pair.replace(first, "data/augment=strong")

    def begun(name: str, model: str, steps: int, words: str) -> Run:
        return Run(name, OBJECTS[name.split("_")[0]], model, steps, words)

    def run(name: str, steps: int, start: str, without: str) -> Run:
        words = [short, without, _after(start)]
        return begun(name, "pose_pf", steps, " ".join(filter(None, words)))

    def far(name: str, steps: int, start: str = CRACKER) -> Run:
        return run(name, steps, start, first)

    def near(name: str, steps: int, start: str = CRACKER) -> Run:
        return run(name, steps, start, f"{PLAIN} {NEAR}")

    def dim(name: str, steps: int, start: str) -> Run:
        return run(name, steps, start, f"{DIM} {NEAR}")

    def now(name: str, steps: int, start: str) -> Run:
        return run(name, steps, start, "")

    def more(name: str, steps: int, start: str) -> Run:
        """From here on, the likelihood learns from all 16 images of a batch, and not from 8."""
        return run(name, steps, _best(start), "model.likelihood_batch_size=16")

    def shipped(name: str, steps: int) -> Run:
        """From here on, scenes differ from object to object; begun with what shipped."""
        weights = f"weights/{OBJECTS[name.split('_')[0]]}.ckpt"
        return run(name, steps, weights, "model.likelihood_batch_size=16")

    earlier = [
        begun("mustard_pose_camera", "pose_pf", 300, f"data/augment=camera {pair}"),
        begun("mustard_pose_strong", "pose_pf", 300, strong),
        begun("sugar_pose_camera", "pose_pf", 300, few),
        begun("mug_pose_camera", "pose_pf", 300, few),
        begun("gelatin_pose_camera", "pose_pf", 250, few),
        begun("chef_can_pose_camera", "pose_pf", 200, few),
        begun("foam_pose_camera", "pose_pf", 150, few),
        begun("drill_pose_camera", "pose_pf", 300, few),
        begun("drill_patch_camera", "patch_pf", 4000, whole),
        begun("mustard_patch_camera", "patch_pf", 1000, after_drill),
        begun("sugar_patch_camera", "patch_pf", 1000, after_drill),
        far("gelatin_a", 1000, _best("gelatin_pose_camera")),
        near("gelatin_b", 600, _best("gelatin_a")),
        near("gelatin_c", 500, _best("gelatin_b")),
        far("mug_a", 1000, _best("mug_pose_camera")),
        near("mug_b", 600, _best("mug_a")),
        dim("mug_c", 800, _best("mug_b")),
        far("foam_a", 1000),
        near("foam_b", 600, _best("foam_a")),
        dim("foam_c", 1000, _best("foam_b")),
        run("foam_d", 800, _best("foam_c"), NEAR),
        now("foam_e", 500, _best("foam_d")),
        near("chef_b", 700, _best("chef_can_pose_camera")),
        near("chef_c", 900, _best("chef_b")),
        near("drill_b", 900),
        now("drill_c", 600, _best("drill_b")),
        near("meat_b", 350),
        now("meat_c", 500, _best("meat_b")),
        near("soup_b", 350),
        near("soup_c", 450, _best("soup_b")),
        near("soup_d", 800, _best("soup_c")),
        now("soup_e", 400, _best("soup_d")),
        near("sugar_b", 400, _best("sugar_pose_camera")),
        near("mustard_b", 400, _best("mustard_pose_camera")),
        now("bowl_b", 500, _best("mug_c")),
        now("tuna_b", 500, _best("soup_d")),
        now("hammer_b", 500, _best("drill_c")),
        near("banana_b", 350),
        more("foam_f", 800, "foam_d"),
        more("soup_f", 800, "soup_e"),
        more("mug_d", 700, "mug_c"),
        more("tuna_c", 700, "tuna_b"),
        more("hammer_c", 800, "hammer_b"),
        more("chef_d", 600, "chef_c"),
        more("banana_c", 800, "banana_b"),
        more("bowl_c", 700, "bowl_b"),
        more("meat_d", 700, "meat_c"),
        more("drill_d", 600, "drill_c"),
        more("mustard_c", 500, "mustard_b"),
        more("sugar_c", 500, "sugar_b"),
        more("drill_e", 1200, "drill_d"),  # the control of drill_f
        shipped("soup_g", 1200),
        shipped("foam_g", 1000),
        shipped("drill_f", 1200),
        shipped("sugar_d", 1000),
        shipped("mug_e", 1000),
        shipped("mustard_d", 1000),
        shipped("chef_e", 900),
        run("foam_h", 900, _best("foam_g"), "model.likelihood_batch_size=16"),
        run("foam_i", 900, _best("foam_h"), "model.likelihood_batch_size=16"),
        shipped("meat_e", 700),
        shipped("tuna_d", 1000),
        shipped("banana_d", 1000),
        shipped("bowl_d", 1000),
        shipped("hammer_d", 1000),
        shipped("gelatin_d", 1000),
        shipped("cracker_c", 1000),
        shipped("chef_f", 1000),
        shipped("soup_h", 1000),
        shipped("drill_g", 1000),
        shipped("mug_f", 1500),
        more("mug_g", 1000, "mug_f"),
        shipped("hammer_e", 1000),
    ]
    # from here on, the likelihood has its surface term
    names = (
        "meat", "hammer", "foam", "mug", "drill", "banana", "mustard", "chef", "bowl", "cracker",
        "tuna", "soup", "sugar",
    )  # fmt: skip
    judged = [shipped(f"{name}_s", 600) for name in names]
    judged.append(more("mug_t", 600, "mug_s"))
    # from here on, of the third set
    steps = {
        "meat": 2000, "bowl": 2000, "hammer": 2000, "mug": 2000, "banana": 1600, "tuna": 2000,
        "sugar": 2000, "mustard": 2000, "cracker": 4000, "chef": 1600, "gelatin": 1600,
        "foam": 1600,
    }  # fmt: skip
    third = [shipped(f"{name}_u", count) for name, count in steps.items()]
    # after turns by texture
    third += [shipped("sugar_v", 3000), shipped("mug_v", 2000), shipped("soup_v", 1500)]
    judged += [one._replace(scenes=THIRD) for one in third]
    # of the fourth set, validated at the end alone
    for name in ("sugar_w", "mug_w"):
        last = shipped(name, 1200)
        words = f"{last.words} trainer.val_check_interval=1200"
        judged.append(last._replace(words=words, scenes=FOURTH))
    # of the fifth set, many images magnified as windows are; validated at the end alone
    sized = f"{_STEPS}.1.object_size_probability=0.4 trainer.val_check_interval=1500"
    for name in ("banana", "hammer", "gelatin", "mug", "mustard", "tuna"):
        last = shipped(f"{name}_x", 1500)
        words = f"{last.words.replace('=camera ', '=camera_magnified ')} {sized}"
        judged.append(last._replace(words=words, scenes=FIFTH))
    # of the sixth set, for longer, validated at the end, and the longest half way, too; the
    # checkpoint that ships is the last
    sized = f"{_STEPS}.1.object_size_probability=0.25"
    tested = "data.min_visibility_test=0.1 data.limit_val=48 data.limit_test=2"
    for name, (_, _, count) in SIXTH_RUNS.items():
        last = shipped(f"{name}_y", count)
        words = last.words.replace(short, f"data/augment=camera_magnified {tested}")
        words = f"{words} {sized} trainer.val_check_interval={count if count < 7000 else 3500}"
        judged.append(last._replace(words=words, scenes=SIXTH))
    return [*map(_without_surface, earlier), *judged]


def _without_surface(run: Run) -> Run:
    """Return a run of pose_pf with the likelihood that was the default when it was made."""
    if run.model != "pose_pf":
        return run
    return run._replace(words=f"{run.words} model/likelihood=contextual")


def _best(run: str) -> str:
    """Return where a run's checkpoint is, below a root that is put in later."""
    return f"{{root}}/runs/{run}/checkpoints/best.ckpt"


def _after(checkpoint: str) -> str:
    return f"warm_start={checkpoint}"
