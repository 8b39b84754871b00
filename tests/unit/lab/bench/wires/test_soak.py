"""What `cell bench soak` and `cell bench servo` reckon with, against numbers that are known."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.arm.child.streaming import pace_of
from lab.bench.wires.soak import MOST_GROWTH, counted, descendants, growth_of, verdict


def rows(memory: list[float], handles: list[float]) -> list[dict[str, object]]:
    return [
        {"processes": {"this program": {"memory_mb": m, "threads": 9.0, "handles": h}}}
        for m, h in zip(memory, handles, strict=True)
    ]


def test_growth_is_that_of_the_jobs_after_the_first_and_one_odd_job_makes_none():
    steady = rows([300.0, 380.0, 400.0, 400.2, 460.0, 400.1, 400.3, 400.2], [20.0] * 8)
    assert verdict(growth_of(steady)) == "nothing grows"
    leaking = rows([300.0 + 2.0 * k for k in range(8)], [20.0 + k // 2 for k in range(8)])
    growth = growth_of(leaking)["this program"]
    assert (growth["memory_mb"], growth["handles"]) == (pytest.approx(2.0), pytest.approx(0.5, abs=0.11))
    assert verdict(growth_of(leaking)) == (
        f"grows: this program: memory_mb +2.00 a job (allowed {MOST_GROWTH['memory_mb']:g}); "
        f"this program: handles +{growth['handles']:.2f} a job (allowed {MOST_GROWTH['handles']:g})"
    )
    assert verdict(growth_of(steady[:4])).startswith("none: at least 5 jobs")


def test_what_this_program_has_started_is_counted_under_its_name():
    program = [sys.executable, "-c", "print(flush=True); input()"]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()  # before this it is a fork of ours, or holds nothing yet
        assert child.pid in descendants(os.getpid())
        found = counted(os.getpid())
        assert set(found) >= {"this program", Path(sys.executable).name}
        assert all(row["memory_mb"] > 3.0 and row["threads"] >= 1.0 and row["handles"] >= 3.0 for row in found.values())
        child.communicate(b"\n")


def test_a_pace_is_told_by_its_rate_and_its_gaps():
    times = [0.002 * k for k in range(201)]
    times[100] += 0.001
    pace = pace_of(times)
    assert (pace.points, pace.rate, pace.median) == (201, pytest.approx(500.0), pytest.approx(0.002))
    assert (pace.p99, pace.longest) == (pytest.approx(0.002), pytest.approx(0.003))
    assert pace_of([0.0, 1.0]) is None
