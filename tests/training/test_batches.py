# ruff: noqa: E402 - torch is not installed everywhere
"""Batches of randomly changed samples."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from automodel.training import batches, dataset
from automodel.training.batches import SHOWN, Batches
from automodel.training.dataset import Samples

H, W = dataset.HEIGHT_PX, dataset.WIDTH_PX


def test_batches_are_the_same_for_the_same_seed(samples: Samples) -> None:
    first, second, other = (iter(Batches(samples, W, H, 3, seed)) for seed in (1, 1, 2))
    for _ in range(4):
        batch, same, different = next(first), next(second), next(other)
        assert batch.shape[:2] == (3, 2)
        assert batch.shape[3] == W
        assert batch.dtype == torch.uint8
        assert torch.equal(batch, same)
        assert batch.shape != different.shape or not torch.equal(batch, different)


def test_a_training_goes_on_with_the_batches_that_it_would_have_had(samples: Samples) -> None:
    whole, later = Batches(samples, W, H, 3, 1), Batches(samples, W, H, 3, 1)
    later.start = 3
    first = list(itertools.islice(whole, 5))[3:]
    assert all(torch.equal(a, b) for a, b in zip(first, later, strict=False))


def test_image_and_mask_change_together(samples: Samples) -> None:
    places = set()
    for batch in itertools.islice(Batches(samples, W, H, 4, 0), 8):
        for grey, mask in batch.numpy():
            if not (mask == 255).any():
                continue  # the part enlarged holds no line
            middle = 0.5 * (np.percentile(grey[mask == 0], 50) + np.percentile(grey[mask == 255], 50))
            assert np.mean(grey[mask == 255] > middle) > 0.99
            assert np.mean(grey[mask == 0] < middle) > 0.99
            places.add(int(np.flatnonzero(mask[0]).mean()))
    assert len(places) > 16  # of 32, more than the eight as drawn and their mirror images
    assert max(places) > 0.75 * W  # where none is drawn


def test_each_sample_comes_once_a_round(samples: Samples) -> None:
    found = Batches(samples, W, H, 4, 5)
    rounds = [found.indices(2 * k) + found.indices(2 * k + 1) for k in range(2)]
    assert sorted(rounds[0]) == sorted(rounds[1]) == list(range(8))
    assert rounds[0] != rounds[1]
    assert Batches(samples, W, H, 4, 5).indices(3) == rounds[1][4:]  # without those before


def test_some_batches_show_only_the_lower_rows(samples: Samples, monkeypatch: pytest.MonkeyPatch) -> None:
    ramp = torch.arange(H, dtype=torch.uint8)[:, None].expand(H, W)
    monkeypatch.setattr(batches, "ZOOM", 1.0)
    monkeypatch.setattr(batches, "STRETCH", 1.0)
    found = Batches(samples, W, H, 2, 0)
    monkeypatch.setattr(found, "_taken", lambda indices: ramp.expand(len(indices), 2, H, W))
    rows = set()
    for batch in itertools.islice(found, 24):
        rows.add(batch.shape[2])
        assert torch.equal(batch[0, 1], ramp[H - batch.shape[2] :])  # the mask is neither toned nor noisy
    assert rows == {round(share * H) for share in SHOWN}


def test_a_view_is_shown_whole(samples: Samples) -> None:
    found = Batches(samples, W, H, 2, 0, shown=(1.0,))
    assert {batch.shape[2] for batch in itertools.islice(found, 12)} == {H}


def test_a_batch_has_the_size_of_the_network(samples: Samples) -> None:
    for batch in itertools.islice(Batches(samples, 256, 128, 5, 0), 6):
        assert batch.shape[:2] == (5, 2)
        assert batch.shape[2] % 8 == 0
        assert batch.shape[2] <= 128
        assert batch.shape[3] == 256


def test_nothing_to_learn_from_is_an_error() -> None:
    with pytest.raises(ValueError, match="no samples"):
        Batches(Samples([]), W, H, 1, 0)
