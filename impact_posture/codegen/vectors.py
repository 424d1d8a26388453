"""C text that every export has: vector types, and the sine and cosine of many angles at once."""

from __future__ import annotations

from dataclasses import dataclass
from string import Template

from impact_posture.codegen.emitter import Real


@dataclass(frozen=True)
class _Trigonometry:
    """Constants of a type: integers of its size, the largest angle, a number whose last bit is one, polynomials."""

    integer: str
    far: str
    round: str
    two_over_pi: str
    part: tuple[str, str, str]
    sine: tuple[str, ...]
    cosine: tuple[str, ...]


# Range reduction by three parts of pi/2 (W. J. Cody and W. Waite, Software Manual for the Elementary Functions,
# 1980); the numbers for doubles are those of fdlibm (k_sin.c, k_cos.c, e_rem_pio2.c; Sun Microsystems, 1993), those
# for floats of Cephes (sinf.c; S. L. Moshier).
_DOUBLE = _Trigonometry(
    integer="unsigned long long",
    far="1000000.0",
    round="6755399441055744.0",
    two_over_pi="0.63661977236758134308",
    part=("1.57079632673412561417", "6.07710050630396597660e-11", "2.02226624879595063154e-21"),
    sine=(
        "1.58969099521155010221e-10", "-2.50507602534068634195e-8", "2.75573137070700676789e-6",
        "-1.98412698298579493134e-4", "8.33333333332248946124e-3", "-1.66666666666666324348e-1",
    ),
    cosine=(
        "-1.13596475577881948265e-11", "2.08757232129817482790e-9", "-2.75573143513906633035e-7",
        "2.48015872894767294178e-5", "-1.38888888888741095749e-3", "4.16666666666666019037e-2",
    ),
)  # fmt: skip
_FLOAT = _Trigonometry(
    integer="unsigned int",
    far="8000.0f",
    round="12582912.0f",
    two_over_pi="0.6366197723675814f",
    part=("1.5703125f", "4.837512969970703125e-4f", "7.54978995489188e-8f"),
    sine=("-1.9515295891e-4f", "8.3321608736e-3f", "-1.6666654611e-1f"),
    cosine=("2.443315711809948e-5f", "-1.388731625493765e-3f", "4.166664568298827e-2f"),
)

LARGEST_VECTOR = 64
"""Bytes of the widest vectors that the text asks for, and of a batch's widest group of narrower ones."""

_PORTABLE = Template("""\
/* Sines and cosines of count angles. */
APART static void ${prefix}_sincos(const $real *angle, $real *sine, $real *cosine, int count)
{
  int k;
  for (k = 0; k < count; ++k) {
    sine[k] = $sin(angle[k]);
    cosine[k] = $cos(angle[k]);
  }
}
""")

_TEXT = Template("""\
#ifndef __GNUC__
#error "needs the vectors of GCC or Clang; generate with --portable for other compilers"
#endif
/* Bytes of a vector, and how many of them a batch takes at once: what suits the instructions and the caches. */
/* Numbers that stand side by side by chance: making vectors of them costs more than it saves. */
#if !defined(__clang__)
#pragma GCC optimize("no-tree-slp-vectorize")
#endif
#if defined(__AVX512F__)
#define ${upper}_VECTOR 64
#define ${upper}_GROUPS 1
#elif defined(__AVX__)
#define ${upper}_VECTOR 32
#define ${upper}_GROUPS 2
#else
#define ${upper}_VECTOR 16
#define ${upper}_GROUPS 4
#endif
#define ${upper}_LANES (${upper}_VECTOR / (int)sizeof($real))
/* One number of a vector in memory. */
#define ${upper}_AT(vector, lane) (((const $real *)&(vector))[lane])
/* A single call waits less for two narrow vectors than for one wide one. */
#define ${upper}_TURNS (${upper}_VECTOR < 32 ? ${upper}_VECTOR : 32)
/* Numbers of several twin branches (r2, r4; u for those at any address), or of several configurations. */
typedef $real ${prefix}_r2 __attribute__((vector_size($two)));
typedef $real ${prefix}_r4 __attribute__((vector_size($four)));
typedef $real ${prefix}_r2u __attribute__((vector_size($two), aligned($one), may_alias));
typedef $real ${prefix}_r4u __attribute__((vector_size($four), aligned($one), may_alias));
typedef $real ${prefix}_rn __attribute__((vector_size(${upper}_VECTOR)));
typedef $integer ${prefix}_in __attribute__((vector_size(${upper}_VECTOR)));

#define V2 ${prefix}_r2
#define V2u ${prefix}_r2u
#define V4 ${prefix}_r4
#define V4u ${prefix}_r4u
#define VN ${prefix}_rn
typedef $real ${prefix}_rt __attribute__((vector_size(${upper}_TURNS)));
typedef $integer ${prefix}_it __attribute__((vector_size(${upper}_TURNS)));
""")

_SINCOS = Template("""\
/* Sines and cosines of count angles, a multiple of the vectors' lanes; all arrays apart from each other. */
__attribute__((unused)) APART static void ${prefix}_${name}(const $real *angle, $real *sine, $real *cosine, int count)
{
  int k, i, far = 0;
  for (k = 0; k < count; ++k) {
    far |= !(angle[k] < $far && angle[k] > -$far);
  }
  if (far) {
    for (k = 0; k < count; ++k) {
      sine[k] = $sin(angle[k]);
      cosine[k] = $cos(angle[k]);
    }
    return;
  }
  for (k = 0; k < count; k += (int)(sizeof(${prefix}_$vector) / sizeof($real))) {
    /* The nearest multiple of pi/2 is in the last bits of a number as large as this. */
    ${prefix}_$vector x, turns, z, s, c;
    ${prefix}_$bits bits, odd, a, b;
    memcpy(&x, angle + k, sizeof x);
    turns = x * $two_over_pi + $round;
    memcpy(&bits, &turns, sizeof bits);
    turns -= $round;
    x = ((x - turns * $part0) - turns * $part1) - turns * $part2;
    z = x * x;
    s = x + x * z * $sine;
    c = ($unit - $half * z) + z * z * $cosine;
    odd = -(bits & 1);
    memcpy(&a, &s, sizeof a);
    memcpy(&b, &c, sizeof b);
    for (i = 0; i < 2; ++i) {
      const ${prefix}_$bits found = (i == 0 ? (a & ~odd) | (b & odd) : (b & ~odd) | (a & odd))
        ^ (((bits + i) & 2) << $sign);
      memcpy((i == 0 ? sine : cosine) + k, &found, sizeof found);
    }
  }
}
""")


def vector_text(prefix: str, real: Real, *, portable: bool = False) -> str:
    """The C of the types and of ``<prefix>_sincos``; without vectors if ``portable``."""
    if portable:
        sine, cosine = (real.spelled(f"{name}(").rstrip("(") for name in ("sin", "cos"))
        return _PORTABLE.substitute(prefix=prefix, real=real.name, sin=sine, cos=cosine)
    numbers = _DOUBLE if real.name == "double" else _FLOAT
    facts = dict(
        prefix=prefix,
        upper=prefix.upper(),
        real=real.name,
        one=real.size,
        two=2 * real.size,
        four=4 * real.size,
        sign=8 * real.size - 2,
        sin=real.spelled("sin(").rstrip("("),
        cos=real.spelled("cos(").rstrip("("),
        unit=real.literal(1.0),
        half=real.literal(0.5),
        sine=_horner(numbers.sine),
        cosine=_horner(numbers.cosine),
        integer=numbers.integer,
        far=numbers.far,
        round=numbers.round,
        two_over_pi=numbers.two_over_pi,
        **{f"part{k}": part for k, part in enumerate(numbers.part)},
    )
    single = _SINCOS.substitute(facts, name="sincos", vector="rt", bits="it")
    return (
        _TEXT.substitute(facts)
        + "\n"
        + single
        + "\n"
        + _SINCOS.substitute(facts, name="sincos_lanes", vector="rn", bits="in")
    )


def _horner(coefficients: tuple[str, ...]) -> str:
    """``(… (c0 z + c1) z + …)``, the highest power's coefficient first."""
    text = coefficients[0]
    for other in coefficients[1:]:
        sign, size = ("-", other[1:]) if other.startswith("-") else ("+", other)
        text = f"({text} * z {sign} {size})"
    return text
