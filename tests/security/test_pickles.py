"""A checkpoint's pickle is refused before it is obeyed where it would fill the memory, compute
without end, or hide what it holds."""

import io
import pickle
import zipfile
from collections import Counter, OrderedDict
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import nn

from posefilter.errors import UserError
from posefilter.pickles import check_pickle


class Call:
    """Is pickled as the call of a function."""

    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call


class Shadowed:
    """Is pickled as an ordered dict with attributes of its own."""

    def __init__(self, attributes: dict[str, Any], content: dict[str, Any]) -> None:
        self.attributes, self.content = attributes, content

    def __reduce__(self) -> tuple[Any, ...]:
        items: Iterator[tuple[str, Any]] = iter(self.content.items())
        return OrderedDict, (), self.attributes, None, items


MANY = list(range(2000))
ALIKE = [k * (2**61 - 1) for k in range(2, 50)]  # of one hash
HOSTILE = {
    "a set of one list again and again": ([Call(set, (MANY,)) for _ in range(20)], "is given"),
    "a set of numbers of one hash": (Call(set, (ALIKE,)), "is given"),
    "pairs whose keys nobody has seen": (Call(OrderedDict, ([[one, 0] for one in ALIKE],)), "give"),
    "a list within two tuples": (Call(Counter, ((MANY * 6,),)), "is given"),
    "a storage of its own": (Call(torch.UntypedStorage, (1 << 36,)), "it calls 'torch.storage"),
    "a type of numbers, called": (Call(torch.float32, (1,)), "it calls 'torch float32'"),
    "a quantized storage": (None, "it names 'torch QUInt8"),
    "a quantized type": (None, "it names 'torch quint8"),
    "items that are a text": (Shadowed({"items": "abc"}, {"a": 1}), "attributes of its own"),
    "items that are hidden": (Shadowed({"items": set}, {"a": 1}), "attributes of its own"),
    "attributes that are no dict": (Call(OrderedDict, (), [1]), "attributes of its own"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_it_is_refused_before_it_is_obeyed(what: str) -> None:
    value, expected = HOSTILE[what]
    if what == "a type of numbers, called":  # Python refuses to write it
        data = b"\x80\x02ctorch\nfloat32\nK\x01\x85R."
    elif what == "a quantized storage":
        data = b"\x80\x02ctorch\nQUInt8Storage\n."
    elif what == "a quantized type":
        data = b"\x80\x02ctorch\nquint8\n."
    else:
        data = pickle.dumps({"x": value}, 2)
    with pytest.raises(UserError, match=expected):
        check_pickle(data)


def test_a_list_counts_with_what_is_added_to_it_later() -> None:
    """As the pickle may put it into the tuple while it is empty."""
    items = b"".join(b"K\x01" for _ in range(20_000))
    # L = memo 0 = []; args = (L,); L.extend(items), by the memo; set(*args)
    data = b"\x80\x02]q\x00\x85q\x01h\x00(" + items + b"ecbuiltins\nset\nh\x01R."
    with pytest.raises(UserError, match="is given"):
        check_pickle(data)


def test_what_trainings_write_passes() -> None:
    net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4))
    optimizer = torch.optim.AdamW(net.parameters())
    net(torch.randn(5, 3)).sum().backward()
    optimizer.step()
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, [10, 20, 20])
    content = {
        "state_dict": net.state_dict(),
        "optimizer_states": [optimizer.state_dict()],
        "lr_schedulers": [schedule.state_dict()],
        "names": {"a", "b"},
        "device": torch.device("cpu"),
        "size": torch.Size([2, 3]),
        "large": 1 << 70,
        "parameter": nn.Parameter(torch.zeros(2)),
    }
    file = io.BytesIO()
    torch.save(content, file)
    with zipfile.ZipFile(file) as archive:
        (name,) = (one for one in archive.namelist() if one.endswith("data.pkl"))
        check_pickle(archive.read(name))
