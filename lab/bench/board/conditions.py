"""What may happen to a picture of a board: light, blur, noise, things before it and beside it, and wrong boards.

A condition draws one random view of a board and says what is expected of the detection: to find it, or to refuse.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from cell.measure.vision.board.view import DEFAULT_DICTIONARY, KINDS, MARKER_SHARE, BoardSpec, Kind
from lab.bench.board.render import Lens, Placed, paint, true_pixels

LENSES = (
    Lens(1280, 1024, 1668, 1664, 641.3, 507.6, (-0.1, 0.15, 1e-3, -8e-4, 0.0)),
    Lens(1280, 1024, 2370, 2366, 633.0, 519.0, (-0.06, 0.2, -5e-4, 6e-4, 0.0)),
    Lens(1280, 960, 1050, 1052, 652.0, 470.0, (-0.22, 0.08, 4e-4, 3e-4, -0.01)),
)
Field = NDArray[np.float32]

# Pitch of the pattern in m; the camera goes as near as the picture asks, so it does not matter.
PITCH = 0.02


@dataclass(frozen=True)
class Condition:
    """One line of the campaign. `expect` is "found" or "refused"; `changes` are the settings of `draw_view`."""

    name: str
    expect: str = "found"
    tilt: tuple[float, float] = (0.0, 40.0)
    changes: dict[str, float] = field(default_factory=dict)


CONDITIONS = (
    Condition("even light"), Condition("tilt 0-15 deg", tilt=(0, 15)), Condition("tilt 15-35 deg", tilt=(15, 35)),
    Condition("tilt 35-50 deg", tilt=(35, 50)), Condition("light falls off 4:1", changes={"gradient": 4.0}),
    Condition("edge of a shadow 4:1", changes={"shadow": 4.0}),
    Condition("contrast of 20 DN", changes={"contrast": 20.0}),
    Condition("dark, white at 25 DN", changes={"exposure": 30.0}),
    Condition("glare saturates a spot", changes={"glare": 600.0}),
    Condition("white saturates", changes={"exposure": 400.0}), Condition("defocus sigma 1.5 px", changes={"blur": 1.5}),
    Condition("defocus sigma 3 px", changes={"blur": 3.0}), Condition("motion 5 px", changes={"motion": 5.0}),
    Condition("noise sigma 8 DN", changes={"noise": 8.0}), Condition("hidden 10-20 %", changes={"hidden": 0.15}),
    Condition("hidden 20-30 %", changes={"hidden": 0.25}), Condition("a cable across", changes={"cable": 1.0}),
    Condition("laser line across", changes={"laser": 1.0}), Condition("cluttered background", changes={"clutter": 1.0}),
    Condition("another board beside", changes={"other": 1.0}),
    Condition("all of it a little", changes={"gradient": 2.5, "blur": 1.2, "noise": 3.0, "clutter": 1.0, "laser": 1.0}),
    Condition("two of the same board", "refused", changes={"twin": 1.0}),
    Condition("mirrored", "refused", changes={"mirrored": 1.0}),
    Condition("a smaller board instead", "refused", changes={"resized": -1.0}),
    Condition("a larger board instead", "refused", changes={"resized": 1.0}),
    Condition("larger, part hidden", "refused", changes={"resized": 1.0, "hidden": 0.25}),
    Condition("another kind instead", "refused", changes={"instead": 1.0}),
    Condition("clutter, no board", "refused", changes={"clutter": 1.0, "none": 1.0}),
    Condition("nothing but noise", "refused", changes={"none": 1.0, "noise": 30.0}),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class View:
    """A picture (h, w), the board that the detection is told to look for, and where that board truly is."""

    picture: NDArray[np.uint8]
    spec: BoardSpec
    lens: Lens
    placed: Placed
    pixels: Array


def draw_spec(kind: Kind, rng: np.random.Generator) -> BoardSpec:
    """A board of a kind with columns and rows drawn at random."""
    if kind == "asymmetric_dots":
        return BoardSpec(kind, int(rng.integers(4, 6)), int(rng.choice([7, 9, 11])), PITCH)
    if kind == "charuco":
        dictionary = str(rng.choice(["DICT_5X5_100", "DICT_4X4_50", "DICT_6X6_250"]))
        cols, rows = int(rng.integers(6, 10)), int(rng.integers(5, 8))
        return BoardSpec(kind, cols, rows, PITCH, 0.7 * PITCH, dictionary)
    if kind == "aprilgrid":
        cols, rows = int(rng.integers(5, 8)), int(rng.integers(4, 7))
        return BoardSpec(kind, cols, rows, PITCH, PITCH * MARKER_SHARE[kind], DEFAULT_DICTIONARY[kind])
    cols, rows = int(rng.integers(7, 12)), int(rng.integers(5, 9))
    if kind == "chessboard" and (cols + rows) % 2 == 0 and rng.random() < 0.7:
        rows += 1
    return BoardSpec(kind, cols, rows, PITCH)


def draw_pose(spec: BoardSpec, lens: Lens, tilt: float, rng: np.random.Generator, share: float) -> Array:
    """Pose (4, 4) of a board wholly in the picture, turned any way; `share` of the picture's height is filled."""
    about, roll = rng.uniform(0, 2 * np.pi, 2)
    turn = (
        cv2.Rodrigues(tilt * np.array([np.cos(about), np.sin(about), 0.0]))[0]
        @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    )
    low, high = np.array(Placed(spec, np.eye(4)).bounds).reshape(2, 2).T
    rim = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    middle = rim.mean(axis=0)
    pose = np.eye(4)
    pose[:3, :3] = turn
    distance = lens.fy * float(np.ptp(rim[:, 1])) / (share * lens.height)
    while True:
        pose[:3, 3] = np.array([0.0, 0.0, distance]) - turn @ middle
        seen = lens.project(rim @ turn.T + pose[:3, 3])
        slack = np.array([lens.width, lens.height]) - np.ptp(seen, axis=0) - 12
        if (slack > 0).all():
            break
        distance *= 1.06
    wanted = 6 + rng.uniform(0, 1, 2) * slack - seen.min(axis=0)
    pose[:2, 3] += wanted * distance / (lens.fx, lens.fy) * 0.9
    return pose


def draw_view(condition: Condition, kind: Kind, rng: np.random.Generator) -> View:
    """One random view under a condition."""
    has = condition.changes
    lens = LENSES[int(rng.integers(len(LENSES)))]
    spec = draw_spec(kind, rng)
    shown = spec
    if "resized" in has:
        grow = int(has["resized"])
        shown = BoardSpec(
            kind, spec.cols + 2 * grow * int(rng.integers(0, 2)), spec.rows + 2 * grow, PITCH, spec.marker,
            spec.dictionary,
        )  # fmt: skip
    if "instead" in has:
        others = [other for other in KINDS if other != kind]
        shown = draw_spec(others[int(rng.integers(len(others)))], rng)
    crowd = "other" in has or "twin" in has
    tilt = np.radians(rng.uniform(*condition.tilt))
    placed, second = _placed(shown, lens, tilt, rng, crowd), None
    if crowd:
        while (second := _beside(lens, placed, spec if "twin" in has else _another(spec, rng), rng)) is None:
            placed = _placed(shown, lens, tilt, rng, crowded=True)
    albedo = _background(lens, rng, "clutter" in has)
    if second is not None:
        paint(albedo, lens, second)
    if "none" not in has:
        paint(albedo, lens, placed)
    pixels = true_pixels(lens, placed)
    if "hidden" in has:
        _hide(albedo, pixels, has["hidden"], rng)
    if "cable" in has:
        _cable(albedo, pixels, rng)
    picture = _expose(albedo, lens, pixels, has, rng)
    if "mirrored" in has:
        picture = np.ascontiguousarray(picture[:, ::-1])
    return View(picture, spec, lens, placed, pixels)


def _placed(shown: BoardSpec, lens: Lens, tilt: float, rng: np.random.Generator, crowded: bool = False) -> Placed:
    """A board somewhere in the picture, with room beside it where it is to be `crowded`."""
    share = float(rng.uniform(0.35, 0.45) if crowded else rng.uniform(0.5, 0.85))
    return Placed(shown, draw_pose(shown, lens, tilt, rng, share), 0.85, 0.07, float(rng.uniform(0.6, 1.2)))


def _another(spec: BoardSpec, rng: np.random.Generator) -> BoardSpec:
    """A board that is not `spec`: mostly of the same kind with other columns and rows, else of another kind."""
    if spec.kind == "charuco":
        other = "DICT_4X4_50" if spec.dictionary != "DICT_4X4_50" else "DICT_5X5_100"
        return BoardSpec("charuco", spec.cols, spec.rows, PITCH, spec.marker, other)
    if rng.random() < 0.5:
        return draw_spec("charuco", rng)
    return BoardSpec(spec.kind, spec.cols - 2, spec.rows - 2, PITCH)


def _beside(lens: Lens, placed: Placed, spec: BoardSpec, rng: np.random.Generator) -> Placed | None:
    """A second board that does not overlap the first; None when no place is found."""
    own = true_pixels(lens, placed)
    room = 0.12 * lens.height
    for _ in range(200):
        pose = draw_pose(spec, lens, np.radians(rng.uniform(0, 30)), rng, float(rng.uniform(0.3, 0.4)))
        second = Placed(spec, pose)
        other = true_pixels(lens, second)
        apart = np.maximum(own.min(axis=0) - other.max(axis=0), other.min(axis=0) - own.max(axis=0))
        if apart.max() > room:
            return second
    return None


def _background(lens: Lens, rng: np.random.Generator, clutter: bool) -> Field:
    """A plain bench top, or one full of grain, boxes, lines and dots like those of a board."""
    shape = (lens.height, lens.width)
    albedo = np.full(shape, rng.uniform(0.15, 0.6), dtype=np.float32)
    if not clutter:
        return albedo
    for grain, depth in ((3, 0.05), (25, 0.1), (90, 0.15)):
        small = rng.normal(0, 1, (shape[0] // grain + 2, shape[1] // grain + 2)).astype(np.float32)
        albedo += depth * cv2.resize(small, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    for _ in range(60):
        x, y = int(rng.integers(0, shape[1])), int(rng.integers(0, shape[0]))
        grey = float(rng.uniform(0.05, 0.9))
        what = rng.integers(0, 4)
        if what == 0:
            angle = float(rng.uniform(0, 90))
            box = cv2.boxPoints(((x, y), (float(rng.uniform(10, 150)), float(rng.uniform(10, 150))), angle))
            cv2.fillPoly(albedo, [box.astype(np.int32)], grey, cv2.LINE_AA)
        elif what == 1:
            x2, y2 = int(rng.integers(0, shape[1])), int(rng.integers(0, shape[0]))
            cv2.line(albedo, (x, y), (x2, y2), grey, int(rng.integers(1, 8)), cv2.LINE_AA)
        else:
            cv2.circle(albedo, (x, y), int(rng.integers(4, 22)), grey * 0.3, -1, cv2.LINE_AA)
    return np.clip(albedo, 0.03, 0.95).astype(np.float32)


def _hide(albedo: Field, pixels: Array, share: float, rng: np.random.Generator) -> None:
    """Lay a hand over a part of the board: from a corner, a side or in the middle, until `share` of the points go."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    start = pixels[int(rng.integers(len(pixels)))]
    towards = 0.5 * (low + high) - start
    length = float(np.linalg.norm(towards)) + 1e-9
    grey = float(rng.uniform(0.1, 0.7))
    for reach in np.linspace(5, 0.8 * float(np.linalg.norm(high - low)), 60):
        mask = np.zeros(albedo.shape, dtype=np.uint8)
        palm = start + 0.15 * reach * towards / length
        angle = float(np.degrees(np.arctan2(towards[1], towards[0])))
        cv2.ellipse(mask, _whole(palm), (int(reach), int(0.6 * reach)), angle, 0, 360, 1, -1)
        for finger in (-0.45, -0.15, 0.15, 0.45):
            tip = palm + 1.5 * reach * np.array(
                [np.cos(np.radians(angle) + finger), np.sin(np.radians(angle) + finger)]
            )
            cv2.line(mask, _whole(palm), _whole(tip), 1, max(2, int(0.18 * reach)))
        inside = np.round(pixels).astype(int).clip(0, np.array(albedo.shape)[::-1] - 1)
        if mask[inside[:, 1], inside[:, 0]].mean() >= share:
            break
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.8)
    skin = grey + 0.04 * cv2.GaussianBlur(rng.normal(0, 4, albedo.shape).astype(np.float32), (0, 0), 4)
    albedo += soft * (skin - albedo)


def _cable(albedo: Field, pixels: Array, rng: np.random.Generator) -> None:
    """A bent cable from one side of the board to the other."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    ends = rng.uniform(low, high, (3, 2))
    t = np.linspace(-0.6, 1.6, 80)[:, None]
    path = (1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * ends[1] + t**2 * ends[2]
    width = int(rng.integers(8, 22))
    points = [np.round(path * 16).astype(np.int32).reshape(-1, 1, 2)]
    cv2.polylines(albedo, points, False, float(rng.uniform(0.05, 0.7)), width, cv2.LINE_AA, 4)


def _whole(place: Array) -> tuple[int, int]:
    return int(place[0]), int(place[1])


def _expose(
    albedo: Field, lens: Lens, pixels: Array, has: dict[str, float], rng: np.random.Generator
) -> NDArray[np.uint8]:
    height, width = albedo.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    angle = float(rng.uniform(0, 2 * np.pi))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    middle, extent = 0.5 * (low + high), float(np.linalg.norm(high - low))
    along = ((u - middle[0]) * np.cos(angle) + (v - middle[1]) * np.sin(angle)) / max(extent, 1.0)
    light: Field = np.full(albedo.shape, has.get("exposure", 200.0), dtype=np.float32)
    if "contrast" in has:
        albedo = (0.45 + (albedo - 0.46) * has["contrast"] / (0.78 * 200)).astype(np.float32)
    if "gradient" in has:
        light *= np.exp(np.log(has["gradient"]) * np.clip(along - 0.1, -1.2, 0.5)) * 1.2
    if "shadow" in has:
        light *= np.where(along + 0.15 * np.sin(6 * along) > rng.uniform(-0.25, 0.25), 1.0, 1.0 / has["shadow"])
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), float(rng.uniform(0.6, 8))), dtype=np.float32)
    image: Field = (albedo * light).astype(np.float32)
    if "glare" in has:
        spot = rng.uniform(low, high)
        size = 0.12 * extent
        image += has["glare"] * np.exp(-0.5 * ((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / size**2) * (albedo + 0.2)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), max(has.get("blur", 0.6), 0.6)), dtype=np.float32)
    if "motion" in has:
        image = _smear(image, has["motion"], float(rng.uniform(0, np.pi)))
    if "laser" in has:
        image += _laser(u, v, middle, extent, rng)
    sigma = np.sqrt(np.clip(image, 0, 255) / 40.0 + 0.4**2 + has.get("noise", 0.0) ** 2)
    if "none" in has and "clutter" not in has:
        image = np.full_like(image, 110.0)
    noisy = image + sigma * rng.normal(0, 1, image.shape)
    return np.asarray(np.clip(np.round(noisy), 0, 255), dtype=np.uint8)


def _laser(u: Field, v: Field, middle: Array, extent: float, rng: np.random.Generator) -> Field:
    """A laser line across the board with speckle, saturated along its middle."""
    angle = float(rng.uniform(0, np.pi))
    offset = float(rng.uniform(-0.2, 0.2)) * extent
    across = (u - middle[0]) * np.cos(angle) + (v - middle[1]) * np.sin(angle) - offset
    grains = cv2.GaussianBlur(rng.normal(0, 1, u.shape).astype(np.float32), (0, 0), 0.8)
    speckle = 1 + 0.5 * grains / float(grains.std())
    return np.asarray(450.0 * np.exp(-0.5 * (across / 2.0) ** 2) * np.clip(speckle, 0.1, 3), dtype=np.float32)


def _smear(image: Field, length: float, angle: float) -> Field:
    """Blur by a straight uniform motion of `length` px, symmetric about the middle of the exposure."""
    size = int(np.ceil(length)) + 3 | 1
    kernel = np.zeros((size, size), dtype=np.float64)
    y, x = np.mgrid[0:size, 0:size] - size // 2
    for t in np.linspace(-0.5, 0.5, 201):
        px, py = t * length * np.cos(angle), t * length * np.sin(angle)
        kernel += np.clip(1 - np.abs(x - px), 0, None) * np.clip(1 - np.abs(y - py), 0, None)
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE))
