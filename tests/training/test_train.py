# ruff: noqa: E402 - torch is not installed everywhere
"""The training of the marking network, and the command."""

from __future__ import annotations

import importlib.util
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.command_line import Cli, cli

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from automodel.config.toml_reader import ConfigError
from automodel.perception.markings.unet import MarkingNetwork, UnetConfig, open_session, run_network
from automodel.training import dataset, train
from automodel.training.metrics import measured
from automodel.training.train import TrainConfig, Training, Watcher, rate_factor
from automodel.training.unet import MarkingNet

__all__ = ["cli"]

W, H = 128, 64


def drawn(seed: int, count: int = 2) -> np.ndarray:
    """Floors with two bright lines, at random places: (count, 2, H, W)."""
    rng = np.random.default_rng(seed)
    batch = np.zeros((count, 2, H, W), np.uint8)
    for grey, mask in batch:
        grey[:] = np.clip(rng.normal(rng.uniform(50, 110), 5.0, (H, W)), 0, 255)
        for left in (rng.integers(5, 55), rng.integers(65, 120)):
            grey[:, left : left + 5], mask[:, left : left + 4] = 230, 255
    return batch


def batches() -> Iterator[Any]:
    return (torch.from_numpy(drawn(seed)) for seed in itertools.count())


def training(clock: Iterator[float] | None = None, **keys: Any) -> Training:
    torch.manual_seed(1)
    config = TrainConfig(width_px=W, height_px=H, threads=1, **keys)
    return Training(config, MarkingNet(), (clock or itertools.count()).__next__)


SILENT = Watcher(progress=lambda _: None, better=lambda _: None)


@pytest.fixture(scope="module")
def trained() -> tuple[Training, train.Kept, list[train.Progress], list[train.Kept]]:
    one = training(steps=100)
    progress: list[train.Progress] = []
    better: list[train.Kept] = []
    kept = one.run(batches(), drawn(10_000), Watcher(progress=progress.append, better=better.append))
    return one, kept, progress, better


def test_a_short_training_finds_lines(trained: tuple) -> None:
    _, kept, progress, better = trained
    assert np.mean([each.loss for each in progress[-5:]]) < 0.4 * np.mean([each.loss for each in progress[:3]])
    assert kept.metrics.score > 0.9
    assert kept is better[-1]
    scores = [each.metrics.score for each in better]
    assert scores == sorted(scores)
    assert len(better) > 1


def test_what_is_kept_is_what_was_measured(trained: tuple) -> None:
    _, kept, _, _ = trained
    net = MarkingNet().eval()
    net.load_state_dict(kept.weights)
    grey = drawn(77)[0, 0]
    with torch.no_grad():
        wanted = torch.sigmoid(net(torch.from_numpy(grey)[None, None]))[0, 0].numpy()
    found = run_network(open_session(kept.onnx, "cpu", 1), grey)
    assert np.abs(found / 255.0 - wanted).max() < 0.6 / 255.0 + 1e-3


def test_a_saved_network_is_where_the_next_training_begins(trained: tuple, tmp_path: Path) -> None:
    _, kept, _, _ = trained
    path = tmp_path / "net.pt"
    train.save_weights(path, kept)
    net = MarkingNet()
    train.load_weights(path, net)
    assert all(torch.equal(kept.weights[name], weights) for name, weights in net.state_dict().items())


def test_an_interrupted_training_goes_on_as_if_nothing_had_been(tmp_path: Path) -> None:
    def learn(one: Training, first: int, last: int) -> None:
        for number in range(first, last):
            one.step(torch.from_numpy(drawn(number)), number / 10.0)

    whole, first, second = training(steps=10), training(steps=10), training(steps=10)
    learn(whole, 0, 6)
    learn(first, 0, 3)
    first._check(drawn(10_000), SILENT)
    first.losses.append((3, 0.5))
    first.save(tmp_path / "net.state")
    second.restore(tmp_path / "net.state")
    assert (second.steps, second.losses, second.checks) == (3, first.losses, first.checks)
    assert second.kept is not None
    assert first.kept is not None
    assert (second.kept.onnx, second.kept.metrics) == (first.kept.onnx, first.kept.metrics)
    learn(second, 3, 6)
    for name, value in whole._average.state_dict().items():
        assert torch.allclose(value.float(), second._average.state_dict()[name].float(), atol=1e-5), name


def test_a_file_that_is_no_interrupted_training_is_refused(trained: tuple, tmp_path: Path) -> None:
    _, kept, _, _ = trained
    train.save_weights(tmp_path / "net.state", kept)
    with pytest.raises(ConfigError, match="is not a file of an interrupted training"):
        training(steps=3).restore(tmp_path / "net.state")


def test_the_command_goes_on_where_it_was_interrupted(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("automodel.training.session.passes_self_test", lambda _: True)
    assert cli(*tiny(tmp_path, "--steps", 2)).code == 0
    state = tmp_path / "out" / "marking_256x128.state"
    halfway = torch.load(state, weights_only=True)
    halfway["steps"] = 1
    torch.save(halfway, state)
    said = cli(*tiny(tmp_path, "--steps", 2, "--continue"))
    assert said.code == 0, said.err
    assert "going on from step 1" in said.err
    assert torch.load(state, weights_only=True)["steps"] == 2


@pytest.mark.parametrize(
    "content", [b"", b"text", b"PK\x03\x04 no archive", b"\x80\x02c__builtin__\nprint\n(S'x'\ntR."]
)
def test_weights_that_cannot_be_read_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "net.pt"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"net\.pt: is not a file of this network's weights"):
        train.load_weights(path, MarkingNet())
    with pytest.raises(ConfigError, match="no such file"):
        train.load_weights(tmp_path / "missing.pt", MarkingNet())


@pytest.mark.parametrize(
    "saved", [{}, {"weights": {}}, {"weights": 3}, [1], {"weights": {"stem.0.weight": torch.ones(1)}}]
)
def test_weights_of_another_network_are_refused(tmp_path: Path, saved: object) -> None:
    torch.save(saved, tmp_path / "net.pt")
    with pytest.raises(ConfigError, match="is not a file of this network's weights"):
        train.load_weights(tmp_path / "net.pt", MarkingNet())


def test_the_loss_is_that_of_its_parts() -> None:
    logits = torch.tensor([[2.0, -1.0], [0.5, -4.0]]).reshape(1, 1, 2, 2)
    coverage = torch.tensor([[1.0, 0.0], [0.4, 0.0]]).reshape(1, 1, 2, 2)
    focal, both, squares = 0.0, 0.0, 0.0
    for z, y in zip((2.0, -1.0, 0.5, -4.0), (1.0, 0.0, 0.4, 0.0), strict=True):
        p = 1.0 / (1.0 + math.exp(-z))
        focal -= abs(p - y) ** 1.5 * (y * math.log(p) + (1.0 - y) * math.log(1.0 - p))
        both, squares = both + p * y, squares + p * p + y * y
    wanted = focal / (1.4 + 4e-3) + 1.0 - (2.0 * both + 1.0) / (squares + 1.0)
    assert float(train.loss(logits, coverage)) == pytest.approx(wanted, rel=1e-5)


def test_the_loss_is_least_for_the_truth() -> None:
    coverage = torch.rand((1, 1, 8, 8), generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05
    true = torch.logit(coverage).requires_grad_()
    train.loss(true, coverage).backward()
    assert float(true.grad.abs().max()) < 1e-4
    empty = train.loss(torch.full((1, 1, 8, 8), -20.0), torch.zeros((1, 1, 8, 8)))
    assert float(empty) == pytest.approx(0.0, abs=1e-4)


def test_the_rate_rises_and_falls_to_nearly_nothing() -> None:
    rates = [rate_factor(share) for share in np.linspace(0.0, 1.0, 1001)]
    peak = int(np.argmax(rates))
    assert rates[0] < 0.02
    assert rates[peak] == pytest.approx(1.0, abs=0.01)
    assert 0.02 < peak / 1000 < 0.05
    assert all(a >= b for a, b in itertools.pairwise(rates[peak:]))
    assert rates[-1] == pytest.approx(0.01)
    assert rate_factor(1.5) == rates[-1]


def test_minutes_are_kept_and_the_rate_falls_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[float] = []
    one = training(clock=itertools.count(0.0, 3.0), minutes=2.0)  # each look at the clock takes 3 s

    def step(_: object, share: float) -> float:
        shares.append(share)
        return 1.0

    monkeypatch.setattr(one, "step", step)
    monkeypatch.setattr(one, "_check", lambda *_: None)
    one.kept = object()  # type: ignore[assignment]
    one.run(batches(), [], SILENT)
    assert shares[0] == pytest.approx(3.0 / 120.0)
    assert shares[-1] >= 1.0 - 3 * 3.0 / 120.0
    assert len(shares) > 15


def test_ctrl_c_keeps_the_best_so_far() -> None:
    def until_someone_has_enough() -> Iterator[Any]:
        yield from itertools.islice(batches(), 3)
        raise KeyboardInterrupt

    one = training(steps=1000)
    better: list[train.Kept] = []
    kept = one.run(until_someone_has_enough(), drawn(5), Watcher(progress=lambda _: None, better=better.append))
    assert one.interrupted
    assert better == [kept]
    assert kept.steps <= 3


def test_a_bad_batch_is_passed_over_and_many_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    one = training(steps=100)
    one.step(torch.from_numpy(drawn(0)), 0.5)
    before = {name: value.clone() for name, value in one._net.state_dict().items() if "running" not in name}
    average = {name: value.clone() for name, value in one._average.state_dict().items()}
    real = train.loss
    monkeypatch.setattr(train, "loss", lambda *maps: real(*maps) * math.nan)
    for _ in range(train.MAX_BAD):
        assert math.isnan(one.step(torch.from_numpy(drawn(1)), 0.5))
    now = one._net.state_dict()
    assert all(torch.equal(now[name], value) for name, value in before.items() if "num_batches" not in name)
    assert all(torch.equal(value, average[name]) for name, value in one._average.state_dict().items())
    assert torch.equal(now["stem.1.running_mean"], average["stem.1.running_mean"])
    with pytest.raises(ValueError, match="no longer finite"):
        one.step(torch.from_numpy(drawn(1)), 0.5)


@pytest.mark.parametrize("keys", [{}, {"steps": 3, "minutes": 1.0}, {"steps": 0}, {"minutes": -1.0}])
def test_a_training_has_one_length(keys: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"steps|minutes"):
        TrainConfig(**keys)


def tiny(tmp_path: Path, *more: object) -> list[object]:
    arguments = ["--out", tmp_path / "out", "--samples", 3, "--validation", 2, "--size", "256x128", "--workers", 1]
    arguments += ["--batch", 2]
    return ["train", *arguments, *more]


def test_the_command_draws_trains_and_exports(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # two steps make no network that finds lines: this is about the files
    monkeypatch.setattr("automodel.training.session.passes_self_test", lambda _: True)
    said = cli(*tiny(tmp_path, "--steps", 2, "--json"))
    assert said.code == 0, said.err
    assert said.rows[0]["size"] == "256x128"
    assert said.rows[0]["steps"] in (1, 2)
    assert set(said.rows[0]) >= {"precision", "recall", "iou", "near_precision", "near_recall"}
    out = tmp_path / "out"
    names = {path.name for path in out.iterdir()}
    files = {f"marking_256x128.{kind}" for kind in ("onnx", "pt", "json", "state")}
    assert names == {"data", "MODEL_CARD.md", "marking_256x128_curve.png", *files}
    assert "--steps 2 --batch 2 --rate 0.003 --seed 0`" in (out / "MODEL_CARD.md").read_text(encoding="utf-8")
    assert "drawing 5 samples" in said.err
    again = cli(*tiny(tmp_path, "--steps", 1, "--resume", out / "marking_256x128.pt"))
    assert again.code == 0, again.err
    assert "drawing" not in again.err


def test_a_network_that_fails_its_self_test_is_no_success(cli: Cli, tmp_path: Path) -> None:
    said = cli(*tiny(tmp_path, "--steps", 1))
    assert said.code == 1
    assert "fails the self-test" in said.err.splitlines()[-1]
    with pytest.raises(ConfigError, match="self-test"):
        MarkingNetwork(UnetConfig(model=f"{tmp_path}/out/marking_256x128.onnx", size="256x128", threads=1))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--minutes", 1, "--steps", 3], "automodel train: give --minutes or --steps, not both"),
        (["--minutes", "nan"], "'--minutes': expected a finite number, got nan"),
        (["--samples", 0], "'--samples'"),
        (["--resume", "missing.pt"], "automodel: --resume missing.pt: no such file"),
        (["--continue"], "holds no interrupted training of birdseye"),
    ],
)
def test_wrong_arguments_are_told_before_any_work(cli: Cli, tmp_path: Path, arguments: list, said: str) -> None:
    found = cli("train", "--out", tmp_path / "out", *arguments)
    assert found.code == 2
    assert said in found.line()
    assert not (tmp_path / "out").exists()


def test_without_torch_the_command_says_what_to_install(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    found = cli("train", "--out", tmp_path / "out")
    assert found.code == 2
    assert "training needs torch, which is not installed: pip install 'automodel[train]'" in found.line()


def test_the_seeds_of_training_and_validation_never_meet() -> None:
    for seed in (0, 1, 2000):
        first = dataset.FIRST_TRAINING_SEED * (seed + 1)
        assert first >= 1_000_000 > 100_000  # the most drawn to measure with


def columns(*places: int) -> np.ndarray:
    mask = np.zeros((10, 40), np.uint8)
    mask[:, list(places)] = 255
    return mask


@pytest.mark.parametrize(
    ("marked", "metrics"),
    [
        # two columns are labelled: 10 and 30
        (columns(10, 30), (1.0, 1.0, 1.0, 1.0, 1.0)),
        (columns(10), (1.0, 0.5, 0.5, 1.0, 0.5)),
        (columns(13, 27), (0.0, 0.0, 0.0, 1.0, 1.0)),
        (columns(14, 30), (0.5, 0.5, 1 / 3, 0.5, 0.5)),
        (columns(), (0.0, 0.0, 0.0, 0.0, 0.0)),
        (columns(*range(40)), (0.05, 1.0, 0.05, 14 / 40, 1.0)),
    ],
    ids=["all", "half", "3 px off", "4 px off", "none", "everywhere"],
)
def test_the_metrics_of_known_masks(marked: np.ndarray, metrics: tuple[float, ...]) -> None:
    truth = np.stack((columns(), columns(10, 30)))
    found = measured(lambda _: marked, [truth, truth])
    got = (found.precision, found.recall, found.iou, found.near_precision, found.near_recall)
    assert got == pytest.approx(metrics)


def test_a_mark_near_a_faint_label_is_not_false() -> None:
    truth = np.stack((columns(), columns(10)))
    truth[1, :, 20] = 30  # an eighth of the pixel is marking
    found = measured(lambda _: columns(10, 20), [truth])
    assert found.precision == 0.5
    assert found.near_precision == 1.0
    assert found.recall == found.near_recall == found.score == 1.0
