/* Networks that act: a few observations through all layers in one call, nothing kept. */
#include "activations.h"

#include <math.h>

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
        /* What is not of this WIDTH is never run, and compiled for one vector. */
        if (left >= 4 && WIDTH == 4)
            STEP(LANES / WIDTH < 4 ? 1 : 4, 2)
        else if (left >= 2 && WIDTH < 16)
            STEP(LANES / WIDTH < 2 ? 1 : 2, 4)
        else
            STEP(1, 8)
#undef STEP
    }
}

/* A norm by means and variances of its own, of each of `lanes` inputs, whose features are `lanes`
   apart. */
static void by_statistics(const step_t *step, int64_t lanes, const float *x, float *y) {
    for (int64_t k = 0; k < step->columns; k++) {
        float deviation = sqrtf(step->variance[k] + (float)step->epsilon);
        for (int64_t e = 0; e < lanes; e++) {
            float z = (x[k * lanes + e] - step->mean[k]) / deviation;
            y[k * lanes + e] = step->scale[k] * z + step->shift[k];
        }
    }
}

/* LayerNorm of each of `lanes` inputs, whose features are `lanes` apart. */
static void normalise(const step_t *step, int64_t lanes, const float *x, float *y) {
    int64_t n = step->columns;
    for (int64_t e = 0; e < lanes; e++) {
        double sum = 0, squares = 0;
        for (int64_t k = 0; k < n; k++) sum += x[k * lanes + e];
        float mean = (float)(sum / (double)n);
        for (int64_t k = 0; k < n; k++) {
            float d = x[k * lanes + e] - mean;
            squares += (double)d * d;
        }
        float factor = (float)(1 / sqrt(squares / (double)n + step->epsilon));
        for (int64_t k = 0; k < n; k++) {
            float z = (x[k * lanes + e] - mean) * factor;
            if (step->scale) z *= step->scale[k];
            y[k * lanes + e] = step->shift ? z + step->shift[k] : z;
        }
    }
}

static int64_t padded(int64_t features) { return (features + LANES - 1) / LANES * LANES; }

int NAMED(act, SUFFIX)(const step_t *steps, int64_t count, int64_t batch, int doubles,
                       const void *x, float *y) {
    int64_t lanes = batch == 1 ? 1 : LANES, numbers = doubles ? batch * steps->columns : 0;
    int64_t size = batch == 1 ? 0 : steps->columns;
    for (int64_t s = 0; s < count; s++) {
        size += padded(steps[s].rows);
        if (steps[s].epsilon >= 0) size += padded(steps[s].columns);
    }
    size = padded(size * lanes) + padded(numbers);
    float *place[MOST_STEPS], *next = sb3_sparse_scratch((size_t)size * 4);
    if (!next) return -1;
    const float *input = x;
    if (doubles) {
        for (int64_t i = 0; i < numbers; i++) next[i] = (float)((const double *)x)[i];
        input = next;
        next += padded(numbers);
    }
    if (batch > 1) {
        to_tile(input, batch, steps->columns, LANES, next);
        input = next;
        next += steps->columns * LANES;
    }
    float wrong = 0; /* NaN as soon as a result is not finite */
    for (int64_t s = 0; s < count; s++) {
        const step_t *step = steps + s;
        const float *from = step->from < 0 ? input : place[step->from];
        if (step->epsilon >= 0) {
            (step->mean ? by_statistics : normalise)(step, lanes, from, next);
            from = next;
            next += padded(step->columns) * lanes;
        }
        place[s] = next;
        next += padded(step->rows) * lanes;
        if (batch == 1)
            one(step, from, place[s]);
        else
            several(step, batch, from, place[s]);
        activate(step->activation, (float)step->a, (float)step->b, place[s], step->rows * lanes);
        if (step->add > -2) {
            const float *shortcut = step->add < 0 ? input : place[step->add];
            for (int64_t i = 0; i < step->rows * lanes; i++) place[s][i] += shortcut[i];
        }
        if (step->out < 0) continue;
        float *to = y + step->out * batch;
        if (batch == 1)
            memcpy(to, place[s], (size_t)step->rows * sizeof *to);
        else
            from_tile(place[s], batch, step->rows, LANES, to);
        for (int64_t i = 0; i < step->rows * batch; i++) wrong += to[i] - to[i];
    }
    return wrong != wrong;
}
