"""What a Rerun recording holds."""

from pathlib import Path

import numpy as np

Read = dict[str, dict[str, dict[int | None, np.ndarray]]]


def read_back(path: Path, timeline: str) -> Read:
    """Return a file's content: entity -> component -> time (None: at every one) -> values."""
    from rerun.chunk import RrdReader

    found: Read = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        times = [None] * chunk.num_rows if chunk.is_static else batch.column(timeline).to_pylist()
        for name in batch.schema.names:
            if name not in ("rerun.controls.RowId", timeline):
                rows = found.setdefault(chunk.entity_path, {}).setdefault(name, {})
                rows |= {
                    t: np.array(value)
                    for t, value in zip(times, batch.column(name).to_pylist(), strict=True)
                    if value
                }
    return found
