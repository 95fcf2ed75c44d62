"""The paper's second method: pose from patches (section 4.3)."""

from posefilter.models.image_space import ImageSpace


class PatchPF(ImageSpace):
    """Each particle sees the flattened patch about it and its own location, and remembers in its
    latent.
    """

    legal_losses = (
        "bce",
        "balanced_bce",
        "focal",
        "add",
        "add_s",
        "confidence",
        "offset",
        "chamfer",
    )
    position_width = 2
