"""What a counted coverage says of the true one: k of n worlds inside leave an interval, and few worlds a wide one.

Of 20 worlds a product whose stated 95 % ellipsoids are right has all inside in 36 % of campaigns, 17 or fewer in 8 %.
So a count is held against 90 to 98 % by its interval: it is wrong where no true coverage of that range explains it. Of
20 worlds that is so from 14 on downwards; that too many are inside shows from 183 worlds on.
"""

from __future__ import annotations

WANTED = (0.90, 0.98)
"""True coverage that a stated 95 % ellipsoid may have."""
CONFIDENCE = 0.95


def interval(inside: float, worlds: int) -> tuple[float, float]:
    """Lowest and highest true share that explain `inside` of `worlds` (Clopper and Pearson, Biometrika 26, 1934).

    A mean share of points over worlds counts as that share of the worlds: a world's points are not independent.
    """
    from scipy.special import betaincinv

    if worlds == 0:
        return 0.0, 1.0
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = float(betaincinv(inside, worlds - inside + 1.0, tail)) if inside > 0 else 0.0
    high = float(betaincinv(inside + 1.0, worlds - inside, 1.0 - tail)) if inside < worlds else 1.0
    return low, high


def explained(inside: float, worlds: int) -> bool:
    """Whether some true coverage of the wanted range explains the count."""
    low, high = interval(inside, worlds)
    return low <= WANTED[1] and high >= WANTED[0]


def words(inside: float, worlds: int) -> str:
    """For people."""
    low, high = interval(inside, worlds)
    return f"{inside:g} of {worlds}: true share {100 * low:.0f} to {100 * high:.0f} %"
