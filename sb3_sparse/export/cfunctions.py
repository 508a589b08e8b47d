"""Functions of exported C policies that are written as they are."""

from __future__ import annotations

FUNCTIONS = {
    "bordered": """\
static void bordered(const float *x, float *y, uint32_t units, uint32_t height, uint32_t width,
                     uint32_t above, uint32_t left, float border)
{
    uint32_t row, column;
    for (; units; units--)
        for (row = 0; row < height + 2 * above; row++)
            for (column = 0; column < width + 2 * left; column++)
                *y++ = row >= above && row < height + above && column >= left &&
                       column < width + left ? *x++ : border;
}
""",
    "max_pool": """\
static void max_pool(const float *x, float *y, uint32_t units, uint32_t height, uint32_t width,
                     uint32_t size, uint32_t across, uint32_t down, uint32_t right,
                     uint32_t rows, uint32_t columns)
{
    uint32_t row, column, i, j;
    for (; units; units--, x += size)
        for (row = 0; row < height; row++)
            for (column = 0; column < width; column++) {
                const float *from = x + row * down + column * right;
                float most = *from;
                for (i = 0; i < rows; i++)
                    for (j = 0; j < columns; j++)
                        if (from[i * across + j] > most)
                            most = from[i * across + j];
                *y++ = most;
            }
}
""",
    "copy_each": """\
static void copy_each(const float *x, float *y, uint32_t n)
{
    uint32_t i;
    for (i = 0; i < n; i++)
        y[i] = x[i];
}
""",
    "standardize": """\
static void standardize(const float *x, float *y, uint32_t n, float eps)
{
    float mean = 0.0f, square = 0.0f;
    uint32_t i;
    for (i = 0; i < n; i++)
        mean += x[i];
    mean /= (float)n;
    for (i = 0; i < n; i++)
        square += (x[i] - mean) * (x[i] - mean);
    square = sqrtf(square / (float)n + eps);
    for (i = 0; i < n; i++)
        y[i] = (x[i] - mean) / square;
}
""",
    "one_hot": """\
static void one_hot(const float *x, float *y, uint32_t n, const uint32_t *size)
{
    uint32_t i;
    for (; n; n--, x++, size++)
        for (i = 0; i < *size; i++)
            *y++ = *x == (float)i ? 1.0f : 0.0f;
}
""",
    "argmax": """\
static void argmax(const float *x, float *y, uint32_t n, const uint32_t *size)
{
    for (; n; n--, x += *size++) {
        uint32_t i, best = 0;
        for (i = 1; i < *size; i++)
            if (x[i] > x[best])
                best = i;
        *y++ = (float)best;
    }
}
""",
    "largest": """\
static void largest(const float *x, float *y, uint32_t n)
{
    float most = *x;
    for (; n; n--, x++)
        if (*x > most)
            most = *x;
    *y = most;
}
""",
}
"""Their texts by name."""
