"""The C functions of exported policies; a policy contains only those it calls."""

from __future__ import annotations

from string import Template

GROUP = 8
"""Rows of a linear layer that are computed side by side."""
INDEX_TYPES = {8: "uint8_t", 16: "uint16_t", 32: "uint32_t"}
_LANES = range(GROUP)

_LINEAR = Template("""\
/* y = W x + b. The rows of W, $group side by side and as long as the longest, then one by one. */
static void $name(const float *x, float *y, uint32_t rows, const $index *length,
                  const $index *column, const $type *value, $scales const float *bias)
{
    uint32_t n;
    for (; rows >= $group; rows -= $group, y += $group, bias += $group$next_scales) {
$declare
        for (n = *length++; n; n--, value += $group, column += $group) {
$multiply
        }
$store
    }
    for (; rows; rows--) {
        float a = 0.0f, b = 0.0f;
        for (n = *length++; n > 1; n -= 2, value += 2, column += 2) {
            a += $value0 * x[column[0]];
            b += $value1 * x[column[1]];
        }
        if (n)
            a += (float)*value++ * x[*column++];
        *y++ = *bias++ + $scale (a + b);
    }
}
""")
_DENSE_LINEAR = Template("""\
/* y = W x + b. W by columns of $group rows side by side, then by single rows. */
static void $name(const float *x, float *y, uint32_t rows, uint32_t columns,
                  const $type *value, $scales const float *bias)
{
    uint32_t n;
    for (; rows >= $group; rows -= $group, y += $group, bias += $group$next_scales) {
$declare
        for (n = 0; n < columns; n++, value += $group) {
$multiply
        }
$store
    }
    for (; rows; rows--) {
        float a = 0.0f;
        for (n = 0; n < columns; n++)
            a += (float)*value++ * x[n];
        *y++ = *bias++ + $scale a;
    }
}
""")
_CONV = Template("""\
/* A convolution; offset says where in x a non-zero of the kernel looks from the first place. */
static void $name(const float *x, float *y, uint32_t units, uint32_t height, uint32_t width,
                  uint32_t down, uint32_t right, $length const $index *offset,
                  const $type *value, $scales const float *bias)
{
    uint32_t n, row, column;
    for (; units; units--, y += height * width, bias++) {
        $start
        for (n = 0; n < height * width; n++)
            y[n] = *bias;
        for (n = $count; n; n--) {
            const float *from = x + *offset++;
            const float weight = $scale (float)*value++;
            for (row = 0; row < height; row++)
                for (column = 0; column < width; column++)
                    y[row * width + column] += weight * from[row * down + column * right];
        }$next
    }
}
""")
_UNIT_BY_UNIT = Template("""\
static void $name(const float *x, float *y, uint32_t n$parameters)
{
    uint32_t i;
    for (i = 0; i < n; i++)
        y[i] = $expression;
}
""")
_PLACE_BY_PLACE = Template("""\
static void $name(const float *x, float *y, uint32_t units, uint32_t places$parameters)
{
    uint32_t i, place;
    for (i = 0; i < units; i++)
        for (place = 0; place < places; place++, x++)
            *y++ = $expression;
}
""")
ELEMENTWISE = {
    "normalize": (
        ", const float *mean, const float *rest, const float *scale, float clip",
        "clipped((x[i] - mean[i] - rest[i]) * scale[i], -clip, clip)",
    ),
    "relu": ("", "x[i] < 0.0f ? 0.0f : x[i]"),
    "leaky_relu": (", float slope", "x[i] < 0.0f ? slope * x[i] : x[i]"),
    "elu": (", float slope", "x[i] < 0.0f ? slope * expm1f(x[i]) : x[i]"),
    "exp": ("", "expf(x[i])"),
    "sqrt": ("", "sqrtf(x[i])"),
    "tanh": ("", "tanhf(x[i])"),
    "sigmoid": ("", "0.5f * tanhf(0.5f * x[i]) + 0.5f"),
    "silu": ("", "x[i] * (0.5f * tanhf(0.5f * x[i]) + 0.5f)"),
    "gelu": ("", "0.5f * x[i] * (1.0f + erff(0.70710678f * x[i]))"),
    "gelu_tanh": (
        "",
        "0.5f * x[i] *\n               "
        "(1.0f + tanhf(0.79788456f * (x[i] + 0.044715f * x[i] * x[i] * x[i])))",
    ),
    "mish": ("", "x[i] * tanhf(log1p_exp(x[i]))"),
    "softplus": (", float threshold", "x[i] > threshold ? x[i] : log1p_exp(x[i])"),
    "softsign": ("", "x[i] / (1.0f + fabsf(x[i]))"),
    "hardswish": ("", "x[i] * (clipped(x[i] + 3.0f, 0.0f, 6.0f) / 6.0f)"),
    "tanhshrink": ("", "x[i] - tanhf(x[i])"),
    "softshrink": (", float most", "x[i] - clipped(x[i], -most, most)"),
    "hardshrink": (", float most", "fabsf(x[i]) <= most ? 0.0f : x[i]"),
    "threshold": (", float most, float instead", "x[i] <= most ? instead : x[i]"),
    "add": (", const float *z", "x[i] + z[i]"),
    "multiply": (", const float *z", "x[i] * z[i]"),
    "minimum": (", const float *z", "x[i] < z[i] ? x[i] : z[i]"),
    "positive": ("", "x[i] > 0.0f ? 1.0f : 0.0f"),
}
PER_UNIT = {
    "affine": (", const float *scale, const float *shift", "*x * scale[i] + shift[i]"),
    "clip": (", const float *low, const float *high", "clipped(*x, low[i], high[i])"),
    "slopes": (", const float *slope", "*x < 0.0f ? slope[i] * *x : *x"),
}
HELPERS = {
    "clipped": """\
static float clipped(float x, float low, float high)
{
    return x < low ? low : x > high ? high : x;
}
""",
    "log1p_exp": """\
static float log1p_exp(float x)
{
    return (x > 0.0f ? x : 0.0f) + log1pf(expf(-fabsf(x)));
}
""",
}
"""Functions that expressions may call."""
MATH = ("tanhf", "expm1f", "expf", "erff", "fabsf", "log1pf", "sqrtf")
"""Functions of ``math.h``."""


def linear(name: str, bits: int | None, int8: bool) -> str:
    """Return the function of a linear layer.

    :param bits: bits of an index; None: a dense layer
    :param int8: whether weights are whole numbers with a scale for each row
    """
    position = "n" if bits is None else "column[{i}]"
    multiply = "\n".join(
        f"            a{i} += {_value(i, int8)} * x[{position.format(i=i)}];" for i in _LANES
    )
    names = ", ".join(f"a{i} = {'0.0f' if int8 else f'bias[{i}]'}" for i in _LANES)
    stored = "bias[{i}] + scale[{i}] * a{i}" if int8 else "a{i}"
    fields = {
        **_types(name, bits, int8),
        "declare": f"        float {names};",
        "multiply": multiply,
        "store": "\n".join(f"        y[{i}] = {stored.format(i=i)};" for i in _LANES),
        "value0": _value(0, int8),
        "value1": _value(1, int8),
        "next_scales": f", scale += {GROUP}" if int8 else "",
    }
    return (_DENSE_LINEAR if bits is None else _LINEAR).substitute(fields)


def conv(name: str, bits: int, full: bool, int8: bool) -> str:
    """Return the function of a convolution.

    :param bits: bits of an offset
    :param full: whether all units have every connection, and so share their offsets
    :param int8: as for :func:`linear`
    """
    index = INDEX_TYPES[bits]
    fields = {
        **_types(name, bits, int8),
        "scale": "*scale *" if int8 else "",
        "length": "uint32_t connections," if full else f"const {index} *length,",
        "start": f"const {index} *first = offset;" if full else "",
        "count": "connections" if full else "*length++",
        "next": ("\n        offset = first;" if full else "")
        + ("\n        scale++;" if int8 else ""),
    }
    return _CONV.substitute(fields)


def elementwise(name: str) -> str:
    """Return the function of an operation of :data:`ELEMENTWISE` or :data:`PER_UNIT`."""
    per_unit = name in PER_UNIT
    parameters, expression = (PER_UNIT if per_unit else ELEMENTWISE)[name]
    template = _PLACE_BY_PLACE if per_unit else _UNIT_BY_UNIT
    return template.substitute(name=c_name(name), parameters=parameters, expression=expression)


def c_name(name: str) -> str:
    """Return the name of an elementwise function, different from all names of ``math.h``."""
    return f"{name}_each"


def _types(name: str, bits: int | None, int8: bool) -> dict[str, object]:
    return {
        "name": name,
        "group": GROUP,
        "type": "int8_t" if int8 else "float",
        "index": INDEX_TYPES[bits or 16],
        "scales": "const float *scale," if int8 else "",
        "scale": "*scale++ *" if int8 else "",
    }


def _value(lane: int, int8: bool) -> str:
    return f"(float)value[{lane}]" if int8 else f"value[{lane}]"
