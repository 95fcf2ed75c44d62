"""A cache of what is computed from a network's parameters alone, until one of them changes."""

from collections.abc import Callable, Hashable, Iterable
from typing import Generic, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

from torch import Tensor, nn

T = TypeVar("T")


class _Entry(NamedTuple, Generic[T]):
    state: tuple[tuple[int, int], ...]  # address and version of each tensor
    values: dict[Hashable, T]


class ModuleCache(Generic[T]):
    """Values computed from modules' tensors; each is computed once until a tensor changes.

    A change through `.data` does not tell: `clear` after it, as `PoseEstimator` does where training
    or evaluation begins.

    They lie beside the modules, so that neither a copy nor a file of a module holds them.

    Args:
        max_entries: Values of a module that are kept; beyond that all of its values are dropped.
    """

    def __init__(self, max_entries: int = 32) -> None:
        self._entries: WeakKeyDictionary[nn.Module, _Entry[T]] = WeakKeyDictionary()
        self._max_entries = max_entries

    def get(
        self, module: nn.Module, of: Iterable[Tensor], key: Hashable, make: Callable[[], T]
    ) -> T:
        """Return a value, by `make` where it is not known.

        Args:
            module: Whose value it is.
            of: All tensors that it depends on.
            key: Tells the module's values from each other.
            make: Computes it.
        """
        try:
            state = tuple([(one.data_ptr(), one._version) for one in of])
        except RuntimeError:  # a tensor of inference mode does not tell when it changes
            return make()
        entry = self._entries.get(module)
        known = {} if entry is None or entry.state != state else entry.values
        if key in known:
            return known[key]
        value = make()
        known = known if len(known) < self._max_entries else {}
        # a new dictionary each time, so that threads may read the old one
        self._entries[module] = _Entry(state, {**known, key: value})
        return value

    def clear(self) -> None:
        """Forget everything."""
        self._entries.clear()
