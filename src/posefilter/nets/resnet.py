"""ResNet-18 and -34 (He et al. 2016) with torchvision's parameter names, to load its weight
files.
"""

from pathlib import Path

import torch
from torch import Tensor, nn

from posefilter.errors import UserError, check_choice

CHANNELS = (64, 128, 256, 512)  # of the stages, whose strides are 4, 8, 16 and 32
DEPTHS = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
# statistics of ImageNet's colors, which published weights expect
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions and a skip connection."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample: nn.Module | None = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H / stride, W / stride)."""
        y = self.bn2(self.conv2(torch.relu(self.bn1(self.conv1(x)))))
        return torch.relu(y + (x if self.downsample is None else self.downsample(x)))


class ResNet(nn.Module):
    """The trunk of a ResNet, with a second stem by which geometry enters at stride 2.

    Args:
        kind: "resnet18" or "resnet34".
        weights: A state dict's file or URL, whose classifier (`fc`) is ignored; None for random
            weights.
        frozen: Train the geometry stem only; batch statistics stay as loaded.
        stages: How many of the four stages there are; a file's later ones are ignored.

    Raises:
        UserError: There is no such kind or number of stages, or the file does not fit.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        kind: str = "resnet18",
        weights: str | None = None,
        frozen: bool = False,
        stages: int = 4,
    ) -> None:
        super().__init__()
        check_choice("model.encoder.trunk.kind", kind, *DEPTHS)
        if not 1 <= stages <= len(CHANNELS):
            raise UserError(f"model.encoder.trunk.stages={stages}: must be 1 to {len(CHANNELS)}")
        self.channels = CHANNELS[:stages]
        self.conv1 = nn.Conv2d(3, 64, 7, 2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.geometry = nn.Conv2d(7, 64, 7, padding=3)
        nn.init.zeros_(self.geometry.weight)  # a loaded trunk starts as it was trained
        nn.init.zeros_(self.geometry.bias)  # type: ignore[arg-type]
        inputs = 64
        for i, (outputs, depth) in enumerate(
            zip(self.channels, DEPTHS[kind][:stages], strict=True), start=1
        ):
            blocks = [BasicBlock(inputs, outputs, 1 if i == 1 else 2)]
            blocks += [BasicBlock(outputs, outputs, 1) for _ in range(depth - 1)]
            setattr(self, f"layer{i}", nn.Sequential(*blocks))
            inputs = outputs
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(STD).view(3, 1, 1), persistent=False)
        self.frozen = frozen
        if weights is not None:
            load_trunk(self, weights)
        if frozen:
            for name, parameter in self.named_parameters():
                parameter.requires_grad = name.startswith("geometry.")
            self.train()  # modules begin in training mode without this call, and Lightning keeps it

    def train(self, mode: bool = True) -> "ResNet":
        """Set training mode; a frozen trunk keeps its loaded batch statistics."""
        super().train(mode)
        if self.frozen:
            for part in self.modules():
                if isinstance(part, nn.BatchNorm2d):
                    part.eval()
        return self

    def forward(self, rgb: Tensor, geometry: Tensor) -> list[Tensor]:
        """(B, 3, H, W) in [0, 1], (B, 7, H / 2, W / 2) rounded up -> a map of each stage."""
        x = self.conv1((rgb - self.mean) / self.std)
        x = torch.relu(self.bn1(x + self.geometry(geometry)))
        x = torch.max_pool2d(x, 3, stride=2, padding=1)
        maps = []
        for i in range(1, len(self.channels) + 1):
            x = getattr(self, f"layer{i}")(x)
            maps.append(x)
        return maps


def load_trunk(trunk: ResNet, weights: str) -> None:
    """Load a torchvision ResNet's state dict from a file or URL.

    Raises:
        UserError: It cannot be read, or its parameters do not match the trunk.
    """
    said = f"model.encoder.trunk.weights={weights}"
    remote = weights.startswith(("http://", "https://"))
    if not remote and not Path(weights).is_file():
        raise UserError(f"{said}: no such file (a path, an http address, or null for none)")
    try:
        if remote:
            state = torch.hub.load_state_dict_from_url(
                weights, map_location="cpu", weights_only=True
            )
        else:
            state = torch.load(weights, map_location="cpu", weights_only=True)
    except OSError as error:
        doing = "fetched" if remote else "read"
        raise UserError(f"{said}: cannot be {doing} ({error})") from error
    except Exception as error:  # a damaged file fails in many ways
        raise UserError(f"{said}: not readable as weights ({type(error).__name__})") from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise UserError(f"{said}: should hold tensors by name, as torchvision's files do")
    own = {name for name in trunk.state_dict() if not name.startswith("geometry.")}
    # a count of batches that earlier files lack, and that evaluation does not read
    counts = {name for name in own if name.endswith(".num_batches_tracked")}
    missing = sorted(own - counts - state.keys())
    not_needed = ("fc.", *(f"layer{i}." for i in range(len(trunk.channels) + 1, 5)))
    unexpected = sorted(name for name in state.keys() - own if not name.startswith(not_needed))
    if missing or unexpected:
        name = (missing or unexpected)[0]
        what = "lacks" if missing else "has the unexpected"
        raise UserError(f"{said}: {what} {name}; is it another network than trunk.kind says?")
    known = {name: state[name] for name in own & state.keys()}
    for name, value in trunk.state_dict().items():
        if name in known and known[name].shape != value.shape:
            raise UserError(
                f"{said}: its {name} has shape {tuple(known[name].shape)}, not "
                f"{tuple(value.shape)}; is it another network than trunk.kind says?"
            )
    trunk.load_state_dict({**trunk.state_dict(), **known})
