"""Training samples on disk."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from automodel.config.toml_reader import ConfigError
from automodel.training import dataset
from automodel.training.dataset import Samples, Shard
from tests.support.drawn_samples import drawn

H, W = dataset.HEIGHT_PX, dataset.WIDTH_PX


def test_shards_cover_each_seed_once() -> None:
    found = dataset.shards(Path("data"), 1000, 300)
    seeds = [range(shard.first_seed, shard.first_seed + shard.count) for shard in found]
    assert list(itertools.chain(*seeds)) == list(range(1000, 1300))
    assert len({shard.path for shard in found}) == len(found) == 3


def test_images_come_back_as_they_were_drawn(samples: Samples) -> None:
    assert len(samples) == 8
    for seed in range(8):
        assert np.array_equal(samples[seed], [drawn(seed).image, drawn(seed).mask])
    for index in (-1, 8):
        with pytest.raises(IndexError):
            samples[index]


def test_only_whole_shards_count(tmp_path: Path) -> None:
    shards = dataset.shards(tmp_path, 0, 2 * dataset.SHARD)
    shards[0].path.write_bytes(b"cut off")
    assert dataset.missing(shards) == shards
    small = Shard(path=tmp_path / "small.npy", first_seed=3, count=2)
    dataset.write_shard(small, drawn)
    assert not dataset.missing([small])
    longer = Shard(path=small.path, first_seed=3, count=3)
    assert dataset.missing([longer]) == [longer]
    with pytest.raises(ConfigError, match=r"small.npy: holds \(2, 2, 256, 512\) uint8; delete it"):
        Samples([longer])
    with pytest.raises(ConfigError, match="cannot be read"):
        Samples(shards)


def test_the_data_version_is_of_what_is_drawn() -> None:
    def other(seed: int) -> SimpleNamespace:
        sample = drawn(seed)
        sample.mask[-1, -1] ^= seed == 3
        return sample

    assert dataset.data_version(drawn) == dataset.data_version(drawn)
    assert dataset.data_version(drawn) != dataset.data_version(other)


def test_a_folder_holds_one_version(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    dataset.claim_folder(folder, "one")
    dataset.claim_folder(folder, "one")
    with pytest.raises(ConfigError, match="data version one, not two"):
        dataset.claim_folder(folder, "two")
    (folder / dataset.INDEX).write_text("{")
    with pytest.raises(ConfigError, match="cannot be read"):
        dataset.claim_folder(folder, "one")


def test_the_smaller_size_keeps_the_share_of_marking(samples: Samples) -> None:
    small = dataset.resized(samples[3], 256, 128)
    assert small.shape == (2, 128, 256)
    assert small[1].mean() == pytest.approx(samples[3][1].mean(), abs=0.5)


def test_samples_may_have_another_size(tmp_path: Path) -> None:
    def view(seed: int) -> SimpleNamespace:
        return SimpleNamespace(image=np.full((8, 16), seed, np.uint8), mask=np.zeros((8, 16), np.uint8))

    shards = dataset.shards(tmp_path, 5, 3, 16, 8)
    dataset.write_shard(shards[0], view)
    assert not dataset.missing(shards)
    assert Samples(shards)[2].shape == (2, 8, 16)
    assert dataset.missing(dataset.shards(tmp_path, 5, 3)) == dataset.shards(tmp_path, 5, 3)
