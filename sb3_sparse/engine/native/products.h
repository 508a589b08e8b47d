/* Products of a sparse layer with a tile, forth and back. */
#ifndef SB3_SPARSE_PRODUCTS_H
#define SB3_SPARSE_PRODUCTS_H

#include "vectors.h"

/* y = W x + b on `vectors` vectors of a tile: gather_rows in steps of what registers hold. */
static void gather(int64_t vectors, int64_t rows, const int32_t *start, const int32_t *column,
                   const float *value, const float *bias, const float *gate, int relu,
                   const float *x, float *y) {
    for (int64_t j = 0; j < vectors;) {
        int64_t left = vectors - j, at = j * WIDTH;
        const float *g = gate ? gate + at : 0;
#define STEP(N, U)                                                                        \
    {                                                                                     \
        gather_rows(N, U, TILE, rows, start, column, value, bias, g, relu, x + at, y + at);     \
        j += N;                                                                           \
    }
        if (left >= 8)
            STEP(8, 1)
        else if (left >= 4)
            STEP(4, 2)
        else if (left >= 2)
            STEP(2, 4)
        else
            STEP(1, 8)
#undef STEP
    }
}

/* grad[k] (+)= <g[row of k], x[column of k]>, `vectors` vectors wide, eight connections at once. */
INLINE void dots_of(int64_t vectors, int64_t rows, const int32_t *start, const int32_t *column,
                    const float *g, const float *x, float *grad, int add) {
    for (int64_t r = 0; r < rows; r++) {
        const float *from = g + r * TILE;
        int32_t k = start[r], end = start[r + 1];
        for (; k + 8 <= end; k += 8) {
            const float *to[8];
            vec sum[8];
            for (int q = 0; q < 8; q++) {
                to[q] = x + (int64_t)column[k + q] * TILE;
                sum[q] = (vec){0};
            }
            for (int64_t j = 0; j < vectors; j++) {
                vec d = LOAD(from + j * WIDTH);
                for (int q = 0; q < 8; q++) sum[q] += d * LOAD(to[q] + j * WIDTH);
            }
            totals(sum, grad + k, add);
        }
        for (; k < end; k++) {
            const float *to = x + (int64_t)column[k] * TILE;
            vec sum = {0};
            for (int64_t j = 0; j < vectors; j++)
                sum += LOAD(from + j * WIDTH) * LOAD(to + j * WIDTH);
            grad[k] = (add ? grad[k] : 0) + total(sum);
        }
    }
}

static void dots(int64_t vectors, int64_t rows, const int32_t *start, const int32_t *column,
                 const float *g, const float *x, float *grad, int add) {
    if (vectors == TILE / WIDTH)
        dots_of(TILE / WIDTH, rows, start, column, g, x, grad, add);
    else
        dots_of(vectors, rows, start, column, g, x, grad, add);
}

static void sums(int64_t vectors, int64_t rows, const float *g, float *grad, int add) {
    for (int64_t r = 0; r < rows; r++) {
        vec sum = {0};
        for (int64_t j = 0; j < vectors; j++) sum += LOAD(g + r * TILE + j * WIDTH);
        grad[r] = (add ? grad[r] : 0) + total(sum);
    }
}

#endif
