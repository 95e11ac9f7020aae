"""`bench cluster`: the same results in one process, in two, and on a cluster whose worker is killed."""

from __future__ import annotations

import importlib.util

import pytest

from automodel.bench import cluster
from automodel.bench.cluster import ClusterChoice, measure
from automodel.config import ConfigError


@pytest.mark.slow
def test_a_sweep_gives_the_same_however_it_is_run(cli) -> None:
    pytest.importorskip("distributed")
    said = cli("bench", "cluster", "--cases", 12, "--frames", 3, "--json")
    assert said.code == 0, said.err
    assert [row["way"] for row in said.rows] == ["one process", "2 processes", "Dask, 2 workers"]
    assert all(row["equal"] is True and row["lost"] == 0 and row["cases"] == 12 for row in said.rows)
    assert [row["killed"] for row in said.rows] == [0, 0, 1]
    assert all(row["overhead_ms"] > 0.0 for row in said.rows)
    assert "extrapolated from 12" in said.err


def test_results_that_differ_are_an_error(cli, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [dict.fromkeys(cluster.COLUMNS, 1) | {"equal": equal, "lost": 0} for equal in (True, False)]
    monkeypatch.setattr(cluster, "measure", lambda choice: rows)
    assert cli("bench", "cluster").code == 1


def test_without_dask_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs distributed, .* pip install 'automodel\[cluster\]'"):
        measure(ClusterChoice())
