"""What colour a surface must have to be seen in a given colour: browsers draw 3D through a film-like tone curve.

The curve is three.js' `ACESFilmicToneMapping`, a fit by Stephen Hill to the ACES reference rendering
(https://github.com/TheRealMJP/BakingLab, ACES.hlsl), at an exposure of 1.
"""

from __future__ import annotations

import numpy as np

_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_EXPOSURE = 1.0 / 0.6
#: Of the rational curve: (v (v + a) - b) / (v (c v + d) + e).
_A, _B, _C, _D, _E = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081


def seen_colour(surface: tuple[int, int, int]) -> tuple[int, int, int]:
    """How a surface of this colour looks in full light, sRGB, 0 to 255."""
    v = _IN @ (_linear(surface) * _EXPOSURE)
    curve = (v * (v + _A) - _B) / (v * (_C * v + _D) + _E)
    return _rounded(_OUT @ curve)


def surface_colour(seen: tuple[int, int, int]) -> tuple[int, int, int]:
    """The colour of a surface that looks so in full light, sRGB, 0 to 255; the nearest there is, where none does."""
    y = np.linalg.solve(_OUT, _linear(seen))
    a, b, c = 1.0 - _C * y, _A - _D * y, -_B - _E * y
    v = (-b + np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))) / (2.0 * a)
    rounded = _rounded(np.linalg.solve(_IN, v) / _EXPOSURE)
    # Near black half a step of one channel of the surface is several of another that is seen: rounded together.
    reds, greens, blues = (range(max(part - 1, 0), min(part + 1, 255) + 1) for part in rounded)
    near = ((red, green, blue) for red in reds for green in greens for blue in blues)
    return min(near, key=lambda surface: float(np.sum(np.subtract(seen_colour(surface), seen) ** 2)))


def _linear(colour: tuple[int, int, int]) -> np.ndarray:
    share = np.asarray(colour) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _rounded(linear: np.ndarray) -> tuple[int, int, int]:
    linear = np.clip(linear, 0.0, 1.0)
    share = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return tuple(round(255.0 * part) for part in share.tolist())
