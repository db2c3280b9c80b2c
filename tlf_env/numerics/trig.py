"""Sine, cosine and logarithm in plain arithmetic, for laws that run over many robots at once.

A compiler cannot vectorise a loop that calls the C library, and a vector library may round differently
from the scalar one. These functions use only additions, multiplications, one division and selections:
vector and scalar code give the same bits on every machine. The polynomials are those of Sun's fdlibm
(``k_sin.c``, ``k_cos.c``, ``e_log.c``); errors stay below one unit in the last place
(``tests/test_trig.py``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from tlf_env.numerics.compiled import law

# π/2 in three parts; the first two have 33 bits, so that k times them is exact for |k| < 2²⁰.
HALF_PI_1 = float.fromhex("0x1.921fb544p+0")
HALF_PI_2 = float.fromhex("0x1.0b4611a6p-34")
HALF_PI_3 = float.fromhex("0x1.3198a2e037073p-69")
PER_HALF_PI = 2.0 / math.pi
LARGEST_ANGLE_RAD = 1.6e6  # up to this angle errors stay below one unit in the last place

S_1, S_2, S_3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
S_4, S_5, S_6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
C_1, C_2, C_3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
C_4, C_5, C_6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11

L_1, L_2, L_3 = 6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01
L_4, L_5, L_6 = 2.222219843214978396e-01, 1.818357216161805012e-01, 1.531383769920937332e-01
L_7 = 1.479819860510658591e-01
LN_2_HIGH, LN_2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
MANTISSA_BITS = 52
MANTISSA = 0x000FFFFFFFFFFFFF
BITS_OF_ONE = 0x3FF0000000000000
BITS_OF_SQRT_HALF = 0x3FE6A09E00000000  # √½, rounded down


@intrinsic
def bits_of(_context: Any, _number: Any) -> Any:
    """The 64 bits of a float as a whole number."""

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def float_of(_context: Any, _bits: Any) -> Any:
    """The float that has these 64 bits."""

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), generate


@law
def sincos(angle: float) -> tuple[float, float]:
    """Sine and cosine of an angle in rad; NaN for NaN and infinity.

    The nearest multiple of π/2 is subtracted (Cody and Waite) and the rest kept as a sum of two floats.
    Two polynomials on ±π/4 follow, exchanged and negated according to the quadrant.
    """
    k = np.rint(angle * PER_HALF_PI)
    first = angle - k * HALF_PI_1
    second = k * HALF_PI_2
    high = first - second
    low = ((first - high) - second) - k * HALF_PI_3
    x = high + low
    rest = (high - x) + low

    z = x * x
    cube = z * x
    p = S_2 + z * (S_3 + z * (S_4 + z * (S_5 + z * S_6)))
    sin_x = x - ((z * (0.5 * rest - cube * p) - rest) - cube * S_1)
    p = z * (C_1 + z * (C_2 + z * (C_3 + z * (C_4 + z * (C_5 + z * C_6)))))
    half = 0.5 * z
    near = 1.0 - half
    cos_x = near + (((1.0 - near) - half) + (z * p - x * rest))

    quadrant = k - 4.0 * np.floor(0.25 * k)
    odd = quadrant == 1.0 or quadrant == 3.0
    sin = cos_x if odd else sin_x
    cos = sin_x if odd else cos_x
    sin = -sin if quadrant >= 2.0 else sin
    cos = -cos if quadrant == 1.0 or quadrant == 2.0 else cos
    return sin, cos


@law
def log(x: float) -> float:
    """Natural logarithm of a positive number that is neither subnormal nor infinite.

    x = 2ᵏ(1 + f) with 1 + f between √½ and √2; log(1 + f) by a polynomial in s² with s = f/(2 + f).
    """
    bits = bits_of(x) + (BITS_OF_ONE - BITS_OF_SQRT_HALF)
    k = float((bits >> MANTISSA_BITS) - 1023)
    f = float_of((bits & MANTISSA) + BITS_OF_SQRT_HALF) - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    r = w * (L_2 + w * (L_4 + w * L_6)) + z * (L_1 + w * (L_3 + w * (L_5 + w * L_7)))
    half = 0.5 * f * f
    return s * (half + r) + k * LN_2_LOW - half + f + k * LN_2_HIGH
