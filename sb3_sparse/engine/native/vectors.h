/* Vectors of the instruction set at hand, and what both ways to compute have in common. */
#ifndef SB3_SPARSE_VECTORS_H
#define SB3_SPARSE_VECTORS_H

#include "kernels.h"

#include <string.h>

#if defined(__AVX512F__)
#include <immintrin.h>
#define WIDTH 16
#elif defined(__AVX2__)
#include <immintrin.h>
#define WIDTH 8
#else
#define WIDTH 4
#endif

#ifndef __has_builtin
#define __has_builtin(x) 0
#endif
#if __has_builtin(__builtin_shufflevector)
#define SHUFFLE(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define SHUFFLE(a, b, i, j, k, l) __builtin_shuffle(a, b, (int32_t __attribute__((vector_size(16)))){i, j, k, l})
#endif

typedef float vec __attribute__((vector_size(WIDTH * 4)));
typedef float loose __attribute__((vector_size(WIDTH * 4), aligned(4), may_alias));
#define INLINE static inline __attribute__((always_inline))
#define LOAD(p) ((vec) * (const loose *)(p))
#define STORE(p, v) (*(loose *)(p) = (v))

/* Comparisons are turned so that a NaN stays one. */
INLINE vec positive(vec a) { return (vec)(~(a < 0) & (typeof(a < 0))a); }
INLINE vec where_positive(vec a, vec y) { return (vec)(~(y <= 0) & (typeof(a < 0))a); }

/* Sum of a vector's elements. */
INLINE float total(vec a) {
#if WIDTH == 16
    return _mm512_reduce_add_ps((__m512)a);
#else
    float sum = 0;
    for (int i = 0; i < WIDTH; i++) sum += a[i];
    return sum;
#endif
}

/* Sums of eight vectors, in out[0..7]: transposed by halves and added up. */
INLINE void totals(const vec *a, float *out, int add) {
#if WIDTH >= 8
#if WIDTH == 16
    __m512 p[4], q[2];
    for (int i = 0; i < 4; i++) {
        __m512 u = (__m512)a[2 * i], v = (__m512)a[2 * i + 1];
        p[i] = _mm512_add_ps(_mm512_unpacklo_ps(u, v), _mm512_unpackhi_ps(u, v));
    }
    for (int i = 0; i < 2; i++) {
        __m512d u = _mm512_castps_pd(p[2 * i]), v = _mm512_castps_pd(p[2 * i + 1]);
        q[i] = _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(u, v)),
                             _mm512_castpd_ps(_mm512_unpackhi_pd(u, v)));
    }
    __m512 lanes = _mm512_add_ps(_mm512_shuffle_f32x4(q[0], q[1], 0x88),
                                 _mm512_shuffle_f32x4(q[0], q[1], 0xdd));
    lanes = _mm512_add_ps(lanes, _mm512_shuffle_f32x4(lanes, lanes, 0xb1));
    __m256 sums = _mm512_castps512_ps256(_mm512_shuffle_f32x4(lanes, lanes, 0x08));
#else
    __m256 p = _mm256_hadd_ps(_mm256_hadd_ps((__m256)a[0], (__m256)a[1]),
                              _mm256_hadd_ps((__m256)a[2], (__m256)a[3]));
    __m256 q = _mm256_hadd_ps(_mm256_hadd_ps((__m256)a[4], (__m256)a[5]),
                              _mm256_hadd_ps((__m256)a[6], (__m256)a[7]));
    __m256 sums = _mm256_add_ps(_mm256_permute2f128_ps(p, q, 0x20),
                                _mm256_permute2f128_ps(p, q, 0x31));
#endif
    if (add) sums = _mm256_add_ps(sums, _mm256_loadu_ps(out));
    _mm256_storeu_ps(out, sums);
#else
    for (int i = 0; i < 8; i++) out[i] = (add ? out[i] : 0) + total(a[i]);
#endif
}

/* y[row] = bias[row] + sum of value * x[column], N vectors wide, U connections at once; features are
   `step` apart. */
INLINE void gather_rows(int N, int U, int64_t step, int64_t rows, const int32_t *start,
                        const int32_t *column, const float *value, const float *bias,
                        const float *gate, int relu, const float *x, float *y) {
    for (int64_t r = 0; r < rows; r++) {
        vec sum[8];
        for (int i = 0; i < N * U; i++) sum[i] = (vec){0};
        if (bias)
            for (int j = 0; j < N; j++) sum[j] = bias[r] + (vec){0};
        int32_t k = start[r], end = start[r + 1];
        for (; k + U <= end; k += U)
            for (int u = 0; u < U; u++) {
                const float *from = x + (int64_t)column[k + u] * step;
                vec w = value[k + u] - (vec){0};
                for (int j = 0; j < N; j++) sum[u * N + j] += w * LOAD(from + j * WIDTH);
            }
        for (; k < end; k++) {
            const float *from = x + (int64_t)column[k] * step;
            vec w = value[k] - (vec){0};
            for (int j = 0; j < N; j++) sum[j] += w * LOAD(from + j * WIDTH);
        }
        for (int i = N; i < N * U; i++) sum[i % N] += sum[i];
        for (int j = 0; j < N; j++) {
            vec s = sum[j];
            if (relu) s = positive(s);
            if (gate) s = where_positive(s, LOAD(gate + r * step + j * WIDTH));
            STORE(y + r * step + j * WIDTH, s);
        }
    }
}

typedef float quad __attribute__((vector_size(16)));
typedef float loose_quad __attribute__((vector_size(16), aligned(4), may_alias));

/* A 4x4 block of `from` (rows `stride` apart) transposed into `to` (rows `step` apart). */
INLINE void transpose(const float *from, int64_t stride, float *to, int64_t step) {
    quad a = *(const loose_quad *)from, b = *(const loose_quad *)(from + stride);
    quad c = *(const loose_quad *)(from + 2 * stride), d = *(const loose_quad *)(from + 3 * stride);
    quad ab = SHUFFLE(a, b, 0, 4, 1, 5), cd = SHUFFLE(c, d, 0, 4, 1, 5);
    *(loose_quad *)to = SHUFFLE(ab, cd, 0, 1, 4, 5);
    *(loose_quad *)(to + step) = SHUFFLE(ab, cd, 2, 3, 6, 7);
    ab = SHUFFLE(a, b, 2, 6, 3, 7), cd = SHUFFLE(c, d, 2, 6, 3, 7);
    *(loose_quad *)(to + 2 * step) = SHUFFLE(ab, cd, 0, 1, 4, 5);
    *(loose_quad *)(to + 3 * step) = SHUFFLE(ab, cd, 2, 3, 6, 7);
}

/* to[f, b] = from[b, f] for b < rows and f < columns. */
INLINE void transpose_all(const float *from, int64_t rows, int64_t columns, int64_t stride,
                          float *to, int64_t step) {
    int64_t whole_rows = rows / 4 * 4, whole_columns = columns / 4 * 4;
    for (int64_t b = 0; b < whole_rows; b += 4)
        for (int64_t f = 0; f < whole_columns; f += 4)
            transpose(from + b * stride + f, stride, to + f * step + b, step);
    for (int64_t f = 0; f < columns; f++)
        for (int64_t b = f < whole_columns ? whole_rows : 0; b < rows; b++)
            to[f * step + b] = from[b * stride + f];
}

/* [entries, features] to a tile; what fills it up to a whole vector is 0. */
INLINE void to_tile(const float *rows, int64_t entries, int64_t features, int64_t step, float *tile) {
    transpose_all(rows, entries, features, features, tile, step);
    int64_t padded = (entries + WIDTH - 1) / WIDTH * WIDTH;
    for (int64_t f = 0; f < features && padded > entries; f++)
        memset(tile + f * step + entries, 0, (padded - entries) * sizeof *tile);
}

INLINE void from_tile(const float *tile, int64_t entries, int64_t features, int64_t step,
                      float *rows) {
    transpose_all(tile, features, entries, step, rows, features);
}

#endif
