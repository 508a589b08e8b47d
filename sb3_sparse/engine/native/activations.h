/* Elementwise functions behind a layer, and their slopes. */
#ifndef SB3_SPARSE_ACTIVATIONS_H
#define SB3_SPARSE_ACTIVATIONS_H

#include "vectors.h"

#include <math.h>

typedef int32_t ivec __attribute__((vector_size(WIDTH * 4)));

INLINE vec choose(ivec mask, vec yes, vec no) {
    return (vec)((mask & (ivec)yes) | (~mask & (ivec)no));
}
/* A NaN stays one: no comparison holds for it. */
INLINE vec at_least(vec x, float least) { return choose(x < least, least + (vec){0}, x); }
INLINE vec at_most(vec x, float most) { return choose(x > most, most + (vec){0}, x); }

/* e^x = scale * (1 + rest): x = n ln 2 + r with |r| <= ln 2 / 2, scale = 2^n, rest = e^r - 1 by its
   Taylor series. */
INLINE vec rest_of_exp(vec x, vec *scale) {
    const float to_integer = 12582912; /* 1.5 * 2^23: what is added to it is rounded */
    x = at_most(at_least(x, -87), 88);
    vec n = x * 1.44269504f + to_integer;
    *scale = (vec)((ivec)n << 23); /* the low bits of its pattern are n */
    *scale = (vec)((ivec)*scale + (127 << 23));
    n -= to_integer;
    vec r = (x - n * 0.693145752f) - n * 1.42860677e-6f; /* ln 2 in two parts */
    vec p = r * (1.f / 5040) + 1.f / 720;
    p = p * r + 1.f / 120;
    p = p * r + 1.f / 24;
    p = p * r + 1.f / 6;
    p = p * r + 0.5f;
    return p * (r * r) + r;
}

INLINE vec exp_of(vec x) {
    vec scale, rest = rest_of_exp(x, &scale);
    return scale * rest + scale;
}

/* e^x - 1, accurate near 0 too. */
INLINE vec expm1_of(vec x) {
    vec scale, rest = rest_of_exp(x, &scale);
    return scale * rest + (scale - 1);
}

INLINE vec magnitude(vec x) { return (vec)((ivec)x & 0x7fffffff); }

/* Near 1 it is the distance from 1 that must be right: SAC takes the logarithm of 1 - tanh(x)^2. */
INLINE vec tanh_of(vec x) {
    vec size = at_most(magnitude(x), 10), t = expm1_of(2 * size);
    vec y = choose(size > 0.5f, 1 - 2 / (t + 2), t / (t + 2));
    return (vec)((ivec)y | ((ivec)x & ~0x7fffffff));
}

INLINE vec one_by_one(vec x, float (*function)(float, float, float), float a, float b) {
    for (int i = 0; i < WIDTH; i++) x[i] = function(x[i], a, b);
    return x;
}
static float gelu(float x, float a, float b) {
    (void)a, (void)b;
    return 0.5f * x * (1 + erff(x * 0.707106781f));
}
static float softplus(float x, float beta, float threshold) {
    return x * beta > threshold ? x : log1pf(expf(x * beta)) / beta;
}

INLINE vec activated(int64_t kind, vec x, float a, float b) {
    switch (kind) {
    case RELU: return positive(x);
    case TANH: return tanh_of(x);
    case SIGMOID: return 1 / (1 + exp_of(-x));
    case ELU: return choose(x < 0, a * expm1_of(x), x);
    case CELU: return choose(x < 0, a * expm1_of(x / a), x);
    case SELU: return 1.05070099f * choose(x < 0, 1.67326324f * expm1_of(x), x);
    case GELU: return one_by_one(x, gelu, a, b);
    case GELU_TANH: return 0.5f * x * (1 + tanh_of(0.797884561f * (x + 0.044715f * x * x * x)));
    case SILU: return x / (1 + exp_of(-x));
    case MISH: {
        vec e = exp_of(at_most(x, 20)); /* tanh(ln(1 + e)) = ((1 + e)^2 - 1) / ((1 + e)^2 + 1) */
        vec t = e * (e + 2);
        return x * (t / (t + 2));
    }
    case SOFTPLUS: return one_by_one(x, softplus, a, b);
    case LEAKY_RELU: return choose(x < 0, a * x, x);
    case HARDTANH: return at_most(at_least(x, a), b);
    case HARDSWISH: return x * at_most(at_least(x + 3, 0), 6) / 6;
    default: return x;
    }
}

/* The gradient g times the slope, which is known from the result y. */
INLINE vec sloped(int64_t kind, vec g, vec y, float a, float b) {
    const vec none = {0};
    switch (kind) {
    case RELU: return where_positive(g, y);
    case TANH: return g * (1 - y * y);
    case SIGMOID: return g * (y * (1 - y));
    case ELU: return choose(y > 0, g, g * (y + a));
    case CELU: return choose(y > 0, g, g * (y / a + 1));
    case SELU: return choose(y > 0, g * 1.05070099f, g * (y + 1.05070099f * 1.67326324f));
    case LEAKY_RELU: return choose(y > 0, g, g * a);
    case HARDTANH: return choose((y <= a) | (y >= b), none, g);
    default: return g;
    }
}

/* Constant kinds make each of these loops one for its function alone. */
#define ACTIVATE(KIND)                                                                       \
    case KIND:                                                                               \
        for (int64_t i = 0; i < count; i += WIDTH) STORE(y + i, activated(KIND, LOAD(y + i), a, b)); \
        break;

/* y = f(y), `count` numbers. */
static inline void activate(int64_t kind, float a, float b, float *y, int64_t count) {
    switch (kind) {
        ACTIVATE(RELU) ACTIVATE(TANH) ACTIVATE(SIGMOID) ACTIVATE(ELU) ACTIVATE(CELU) ACTIVATE(SELU)
        ACTIVATE(GELU) ACTIVATE(GELU_TANH) ACTIVATE(SILU) ACTIVATE(MISH) ACTIVATE(SOFTPLUS)
        ACTIVATE(LEAKY_RELU) ACTIVATE(HARDTANH) ACTIVATE(HARDSWISH)
    }
}

#define SLOPE(KIND)                                                                            \
    case KIND:                                                                                 \
        for (int64_t i = 0; i < count; i += WIDTH)                                             \
            STORE(g + i, sloped(KIND, LOAD(g + i), LOAD(y + i), a, b));                        \
        break;

/* g times the slope at y, `count` numbers. */
static inline void slope(int64_t kind, float a, float b, const float *y, float *g, int64_t count) {
    switch (kind) {
        SLOPE(RELU) SLOPE(TANH) SLOPE(SIGMOID) SLOPE(ELU) SLOPE(CELU) SLOPE(SELU) SLOPE(LEAKY_RELU)
        SLOPE(HARDTANH)
    }
}

#endif
