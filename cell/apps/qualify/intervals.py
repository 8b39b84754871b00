"""Shares and means with their 95 % intervals, and how far a process keeps from its limits."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv, stdtrit

CONFIDENCE = 0.95
TAIL = 0.5 * (1.0 - CONFIDENCE)
Z95 = 1.959964
"""Standard deviations within which 95 % of a normal distribution lie."""


@dataclass(frozen=True)
class Share:
    """`count` of `of` worlds with the interval of the true share (Clopper and Pearson, Biometrika 26, 1934). A mean
    share of points counts as that share of the worlds: a world's points are not independent."""

    count: float
    of: int

    @property
    def share(self) -> float:
        """0 to 1; 0 of no world."""
        return self.count / self.of if self.of else 0.0

    @property
    def low(self) -> float:
        """Lowest true share that explains it."""
        return float(betaincinv(self.count, self.of - self.count + 1.0, TAIL)) if self.count > 0 else 0.0

    @property
    def high(self) -> float:
        """Highest true share that explains it."""
        if self.count >= self.of:
            return 1.0
        return float(betaincinv(self.count + 1.0, self.of - self.count, 1.0 - TAIL))

    @property
    def half_width(self) -> float:
        """Half of the interval."""
        return 0.5 * (self.high - self.low)

    def __str__(self) -> str:
        """As people read it, in per cent."""
        return f"{100 * self.share:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"

    def as_dict(self) -> dict[str, float]:
        """JSON-ready."""
        return {"count": self.count, "of": self.of, "share": self.share, "low": self.low, "high": self.high}


def mean_difference(differences: Sequence[float]) -> tuple[float, float | None, float | None]:
    """The mean of paired differences and the ends of its interval by Student's t; one difference alone has none."""
    values = np.asarray(differences, dtype=float)
    mean, n = float(values.mean()), len(values)
    if n < 2:
        return mean, None, None
    half = float(stdtrit(n - 1, 1.0 - TAIL) * values.std(ddof=1) / np.sqrt(n))
    return mean, mean - half, mean + half


def share_difference(better: int, worse: int, pairs: int) -> tuple[float, float, float]:
    """The difference of two shares of the same `pairs`, and its interval (Agresti and Min, Stat. Med. 24, 2005).
    `better` pairs are good in the first only, `worse` in the second only."""
    first, second, n = better + 0.5, worse + 0.5, pairs + 2.0
    centre = (first - second) / n
    half = Z95 * float(np.sqrt(first + second - (first - second) ** 2 / n)) / n
    return (better - worse) / pairs, max(-1.0, centre - half), min(1.0, centre + half)


def cpk(values: Sequence[float], limits: Sequence[float], *, at_least: bool = False) -> float | None:
    """How many times three standard deviations fit between the mean and the nearer limit; None of fewer than two
    values, or where they are all the same.

    An upper limit holds for either sign. Each value is taken in shares of its own limit, which may differ by world.
    """
    shares = np.asarray(values, dtype=float) / np.asarray(limits, dtype=float)
    if len(shares) < 2 or (spread := float(shares.std(ddof=1))) < 1e-12:
        return None
    mean = float(shares.mean())
    return (mean - 1.0 if at_least else 1.0 - abs(mean)) / (3.0 * spread)
