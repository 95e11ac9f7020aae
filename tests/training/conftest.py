"""Samples on disk."""

from __future__ import annotations

import pytest

from automodel.training import dataset
from automodel.training.dataset import Samples, Shard
from tests.support.drawn_samples import drawn


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    """Eight of `drawn`, in two shards."""
    wanted = [
        Shard(path=tmp_path_factory.mktemp("data") / f"{first}.npy", first_seed=first, count=4) for first in (0, 4)
    ]
    for shard in wanted:
        dataset.write_shard(shard, drawn)
    return Samples(wanted)
