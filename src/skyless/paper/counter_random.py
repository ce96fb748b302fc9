"""Random numbers from a counter: number k of draw n depends on seed, n and k alone.

So any thread, or any device, takes any share of the draws, and the draws stay the same. The generator is Philox 4×32
with ten rounds (J. Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC 2011), in signed integers, so that
compiled code and Python agree.
"""

import math
from typing import Final

from skyless.kernels.arrays import Array
from skyless.kernels.compiled import kernel

NUMBERS_PER_BLOCK: Final = 4

_MASK: Final = 0xFFFFFFFF
_MULTIPLIER_A: Final = 0xD2511F53
_MULTIPLIER_B: Final = 0xCD9E8D57
_WEYL_A: Final = 0x9E3779B9
_WEYL_B: Final = 0xBB67AE85
_ROUNDS: Final = 10
_SPACING: Final = 2.0**-32
_UNIFORM_WIDTH: Final = math.sqrt(12.0)

_MIDDLE: Final = 0.425
_MIDDLE_ABOVE: Final = (
    3.3871328727963666080e0,
    1.3314166789178437745e2,
    1.9715909503065514427e3,
    1.3731693765509461125e4,
    4.5921953931549871457e4,
    6.7265770927008700853e4,
    3.3430575583588128105e4,
    2.5090809287301226727e3,
)
_MIDDLE_BELOW: Final = (
    1.0,
    4.2313330701600911252e1,
    6.8718700749205790830e2,
    5.3941960214247511077e3,
    2.1213794301586595867e4,
    3.9307895800092710610e4,
    2.8729085735721942674e4,
    5.2264952788528545610e3,
)
_TAIL_START: Final = 1.6
_TAIL_ABOVE: Final = (
    1.42343711074968357734e0,
    4.63033784615654529590e0,
    5.76949722146069140550e0,
    3.64784832476320460504e0,
    1.27045825245236838258e0,
    2.41780725177450611770e-1,
    2.27238449892691845833e-2,
    7.74545014278341407640e-4,
)
_TAIL_BELOW: Final = (
    1.0,
    2.05319162663775882187e0,
    1.67638483018380384940e0,
    6.89767334985100004550e-1,
    1.48103976427480074590e-1,
    1.51986665636164571966e-2,
    5.47593808499534494600e-4,
    1.05075007164441684324e-9,
)


@kernel
def philox(a: int, b: int, c: int, d: int, key_a: int, key_b: int) -> tuple[int, int, int, int]:
    """Four 32-bit numbers for a counter of four and a key of two 32-bit words.

    The products have up to 64 bits; as signed integers they wrap, and the masks take the right bits all the same.
    """
    for _ in range(_ROUNDS):
        product_a = a * _MULTIPLIER_A
        product_b = c * _MULTIPLIER_B
        a, c = ((product_b >> 32) & _MASK) ^ b ^ key_a, ((product_a >> 32) & _MASK) ^ d ^ key_b
        b, d = product_b & _MASK, product_a & _MASK
        key_a = (key_a + _WEYL_A) & _MASK
        key_b = (key_b + _WEYL_B) & _MASK
    return a, b, c, d


@kernel
def fill_noise(seed: int, draw: int, uniform: bool, noise: Array) -> None:
    """Fill ``noise``, a whole number of blocks, with the numbers of one draw, of mean 0 and variance 1."""
    for block in range(len(noise) // NUMBERS_PER_BLOCK):
        a, b, c, d = philox(draw & _MASK, (draw >> 32) & _MASK, block, 0, seed & _MASK, (seed >> 32) & _MASK)
        at = NUMBERS_PER_BLOCK * block
        if uniform:
            noise[at], noise[at + 1] = standard_uniform(a), standard_uniform(b)
            noise[at + 2], noise[at + 3] = standard_uniform(c), standard_uniform(d)
        else:
            noise[at], noise[at + 1] = standard_normal(a), standard_normal(b)
            noise[at + 2], noise[at + 3] = standard_normal(c), standard_normal(d)


@kernel
def standard_uniform(bits: int) -> float:
    """A number of mean 0 and variance 1, uniform within ±√3, of 32 random bits."""
    return ((bits + 0.5) * _SPACING - 0.5) * _UNIFORM_WIDTH


@kernel
def standard_normal(bits: int) -> float:
    """A standard normal of 32 random bits, at most 6.4: the inverse of its distribution function.

    Rational approximations of M. Wichura (algorithm AS 241, Applied Statistics 37, 1988), exact to 1e-15; the third
    one, beyond 6.4, is out of reach of 32 bits.
    """
    middle = (bits + 0.5) * _SPACING - 0.5
    if abs(middle) <= _MIDDLE:
        return middle * _ratio(_MIDDLE * _MIDDLE - middle * middle, _MIDDLE_ABOVE, _MIDDLE_BELOW)
    tail = math.sqrt(-math.log(0.5 - abs(middle)))
    return math.copysign(_ratio(tail - _TAIL_START, _TAIL_ABOVE, _TAIL_BELOW), middle)


@kernel
def _ratio(x: float, above: tuple[float, ...], below: tuple[float, ...]) -> float:
    numerator, denominator = above[7], below[7]
    for power in range(6, -1, -1):
        numerator = numerator * x + above[power]
        denominator = denominator * x + below[power]
    return numerator / denominator
