/* Networks that act: a few observations through all layers in one call, nothing kept. */
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

INLINE vec tanh_of(vec x) {
    vec t = expm1_of(2 * at_most(at_least(x, -10), 10));
    return t / (t + 2);
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

static void activate(const step_t *step, float *y, int64_t count) {
#define CASE(kind)                                                                   \
    case kind:                                                                       \
        for (int64_t i = 0; i < count; i += WIDTH)                                   \
            STORE(y + i, activated(kind, LOAD(y + i), (float)step->a, (float)step->b)); \
        break;
    switch (step->activation) {
        CASE(RELU) CASE(TANH) CASE(SIGMOID) CASE(ELU) CASE(CELU) CASE(SELU) CASE(GELU)
        CASE(GELU_TANH) CASE(SILU) CASE(MISH) CASE(SOFTPLUS) CASE(LEAKY_RELU) CASE(HARDTANH)
        CASE(HARDSWISH)
    }
#undef CASE
}

/* The first `left` of WIDTH elements, the rest 0. */
INLINE vec first(const float *from, int64_t left) {
#if WIDTH == 16
    return (vec)_mm512_maskz_loadu_ps((__mmask16)((1u << left) - 1), from);
#else
    vec found = {0};
    for (int64_t i = 0; i < left; i++) found[i] = from[i];
    return found;
#endif
}

/* Makes a compiler load one number at a time, which is quicker than what it would gather. */
#if defined(__x86_64__)
#define ALONE(x) __asm__("" : "+x"(x))
#elif defined(__aarch64__)
#define ALONE(x) __asm__("" : "+w"(x))
#else
#define ALONE(x) (void)(x)
#endif

/* sum of value * x[column]. */
INLINE float sparse_row(int64_t count, const int32_t *column, const float *value, const float *x) {
    float sum[8] = {0};
    int64_t k = 0;
    for (; k + 8 <= count; k += 8)
#pragma GCC unroll 8
        for (int i = 0; i < 8; i++) {
            float one = x[column[k + i]];
            ALONE(one);
            sum[i] += value[k + i] * one;
        }
    for (int64_t i = 0; k < count; k++, i++) {
        float one = x[column[k]];
        ALONE(one);
        sum[i & 3] += value[k] * one;
    }
    return ((sum[0] + sum[1]) + (sum[2] + sum[3])) + ((sum[4] + sum[5]) + (sum[6] + sum[7]));
}

/* Weights that count; what does not is 0, even if it is no number. */
INLINE vec counted(vec weights, vec mask) { return (vec)((ivec)weights & (mask != 0)); }

/* sum of weight * x of a row without gaps, to be added up. */
INLINE vec dense_row(int64_t columns, const float *w, const float *mask, const float *x) {
    vec sum = {0}, more = {0};
    const float *m = mask ? mask : w; /* what is 0 adds nothing either way */
    int64_t k = 0, left;
    for (; k + 2 * WIDTH <= columns; k += 2 * WIDTH) {
        sum += counted(LOAD(w + k), LOAD(m + k)) * LOAD(x + k);
        more += counted(LOAD(w + k + WIDTH), LOAD(m + k + WIDTH)) * LOAD(x + k + WIDTH);
    }
    for (; (left = columns - k) > 0; k += WIDTH)
        if (left >= WIDTH)
            sum += counted(LOAD(w + k), LOAD(m + k)) * LOAD(x + k);
        else
            more += counted(first(w + k, left), first(m + k, left)) * first(x + k, left);
    return sum + more;
}

/* y = W x + b for one input. */
static void one(const step_t *step, const float *x, float *y) {
    for (int64_t r = 0; r < step->rows; r++) {
        float bias = step->bias ? step->bias[r] : 0;
        if (!step->row_start) {
            const float *mask = step->mask ? step->mask + r * step->columns : 0;
            y[r] = bias + total(dense_row(step->columns, step->value + r * step->columns, mask, x));
            continue;
        }
        int64_t start = step->row_start[r], count = step->row_start[r + 1] - start;
        if (count == step->columns)
            y[r] = bias + total(dense_row(count, step->value + start, 0, x));
        else
            y[r] = bias + sparse_row(count, step->column + start, step->value + start, x);
    }
}

/* The same for up to LANES inputs of dense weights, N vectors wide; features are LANES apart. */
INLINE void dense_rows(int N, const step_t *step, const float *x, float *y) {
    for (int64_t r = 0; r < step->rows; r++) {
        const float *w = step->value + r * step->columns;
        const float *m = step->mask ? step->mask + r * step->columns : w;
        vec sum[2 * LANES / WIDTH];
        for (int i = 0; i < 2 * N; i++) sum[i] = (vec){0};
        if (step->bias)
            for (int j = 0; j < N; j++) sum[j] = step->bias[r] + (vec){0};
        for (int64_t k = 0; k < step->columns; k++) {
            vec weight = (m[k] != 0 ? w[k] : 0) + (vec){0};
            for (int j = 0; j < N; j++)
                sum[(k & 1) * N + j] += weight * LOAD(x + k * LANES + j * WIDTH);
        }
        for (int j = 0; j < N; j++) STORE(y + r * LANES + j * WIDTH, sum[j] + sum[N + j]);
    }
}

static void several(const step_t *step, int64_t batch, const float *x, float *y) {
    int64_t vectors = (batch + WIDTH - 1) / WIDTH;
    for (int64_t j = 0; j < vectors;) {
        int64_t left = vectors - j, at = j * WIDTH;
#define STEP(N, U)                                                                          \
    {                                                                                       \
        if (step->row_start)                                                                \
            gather_rows(N, U, LANES, step->rows, step->row_start, step->column, step->value, \
                        step->bias, 0, 0, x + at, y + at);                                  \
        else                                                                                \
            dense_rows(N, step, x + at, y + at);                                            \
        j += N;                                                                             \
    }
        if (left >= 4 && WIDTH == 4)
            STEP(LANES / WIDTH < 4 ? 1 : 4, 2)
        else if (left >= 2 && WIDTH < 16)
            STEP(LANES / WIDTH < 2 ? 1 : 2, 4)
        else
            STEP(1, 8)
#undef STEP
    }
}

static int64_t padded(int64_t features) { return (features + LANES - 1) / LANES * LANES; }

int NAMED(act, SUFFIX)(const step_t *steps, int64_t count, int64_t batch, const float *x, float *y) {
    int64_t lanes = batch == 1 ? 1 : LANES, size = batch == 1 ? 0 : steps->columns;
    for (int64_t s = 0; s < count; s++) size += padded(steps[s].rows);
    float *place[64], *next = sb3_sparse_scratch((size_t)(padded(size * lanes) * 4));
    if (!next) return -1;
    const float *input = x;
    if (batch > 1) {
        to_tile(x, batch, steps->columns, LANES, next);
        input = next;
        next += steps->columns * LANES;
    }
    vec wrong = {0};
    for (int64_t s = 0; s < count; s++) {
        const step_t *step = steps + s;
        const float *from = step->from < 0 ? input : place[step->from];
        place[s] = next;
        next += padded(step->rows) * lanes;
        if (batch == 1)
            one(step, from, place[s]);
        else
            several(step, batch, from, place[s]);
        activate(step, place[s], step->rows * lanes);
        if (step->out < 0) continue;
        float *to = y + step->out * batch;
        if (batch == 1)
            memcpy(to, place[s], (size_t)step->rows * sizeof *to);
        else
            from_tile(place[s], batch, step->rows, LANES, to);
        for (int64_t i = 0; i < step->rows * batch; i++) wrong[0] += to[i] - to[i];
    }
    return wrong[0] != wrong[0];
}
