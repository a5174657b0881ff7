"""Conversion between the colour of a surface and its colour on the screen after tone mapping by the browser.

The tone curve is `ACESFilmicToneMapping` of three.js at an exposure of 1, a fit by Stephen Hill to the ACES reference
rendering (https://github.com/TheRealMJP/BakingLab, ACES.hlsl).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Matrix from linear sRGB to the colour space of the curve.
_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
#: Matrix from the colour space of the curve to linear sRGB.
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
#: Factor that three.js applies to linear colours before the curve.
_EXPOSURE = 1.0 / 0.6


@dataclass(frozen=True)
class ToneCurveCoefficients:
    """Coefficients of the rational tone curve (v (v + a) - b) / (v (c v + d) + e), from ACES.hlsl.

    Attributes:
        a, b, c, d, e: The coefficients.
    """

    a: float = 0.0245786
    b: float = 0.000090537
    c: float = 0.983729
    d: float = 0.4329510
    e: float = 0.238081


_CURVE = ToneCurveCoefficients()


def compute_displayed_srgb(surface: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the colour on the screen of a surface in full light, sRGB, 0 to 255.

    Args:
        surface: Colour of the surface, sRGB, 0 to 255.
    """
    v = _IN @ (_decode_srgb_bytes(surface) * _EXPOSURE)
    curve = (v * (v + _CURVE.a) - _CURVE.b) / (v * (_CURVE.c * v + _CURVE.d) + _CURVE.e)
    return _encode_srgb_bytes(_OUT @ curve)


def find_surface_srgb(seen: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the surface colour whose colour on the screen is nearest to a given one, sRGB, 0 to 255.

    Args:
        seen: Desired colour on the screen, sRGB, 0 to 255.
    """
    y = np.linalg.solve(_OUT, _decode_srgb_bytes(seen))
    a, b, c = 1.0 - _CURVE.c * y, _CURVE.a - _CURVE.d * y, -_CURVE.b - _CURVE.e * y
    v = (-b + np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))) / (2.0 * a)
    rounded = _encode_srgb_bytes(np.linalg.solve(_IN, v) / _EXPOSURE)
    # The channels are coupled: near black, rounding one channel of the surface changes another one on the screen by
    # several steps. Therefore all neighbours of the rounded colour are compared.
    reds, greens, blues = (range(max(part - 1, 0), min(part + 1, 255) + 1) for part in rounded)
    neighbours = ((red, green, blue) for red in reds for green in greens for blue in blues)
    return min(neighbours, key=lambda surface: float(np.sum(np.subtract(compute_displayed_srgb(surface), seen) ** 2)))


def _decode_srgb_bytes(colour: tuple[int, int, int]) -> np.ndarray:
    """Convert sRGB, 0 to 255, to linear RGB, 0 to 1 (IEC 61966-2-1)."""
    encoded = np.asarray(colour) / 255.0
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encode_srgb_bytes(linear: np.ndarray) -> tuple[int, int, int]:
    """Convert linear RGB, clipped to 0 to 1, to rounded sRGB, 0 to 255 (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return tuple(round(255.0 * part) for part in encoded.tolist())
