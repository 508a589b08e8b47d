/* Products of a dense layer with one tile: forward, back, and the gradient of its weights.
 *
 * `vectors` of the tile count, 1..TILE / WIDTH. No result may overlap what it is made of. Results
 * do not depend on what the tile holds behind those vectors.
 */
#ifndef SB3_SPARSE_DENSE_H
#define SB3_SPARSE_DENSE_H

#include "vectors.h"

/* A block of results is ROWS rows by ACROSS vectors: 24 registers of 32, or 12 of 16. */
#define ROWS 6
#if WIDTH == 16 || defined(__aarch64__)
#define ACROSS 4
#else
#define ACROSS 2
#endif
#define DEPTH 128 /* terms at once: so many features of a tile stay in the first cache */
#define FEW 16    /* fewer rows do not pay for a transposed tile */

/* y[i] (+)= sum over k < depth of a[i, k] x[k] for i < rows. Here a[i, k] is
   a[i * by_row + k * by_depth], x[k] the vectors at x + k * TILE, y[i] those at y + i * step. */
typedef struct {
    int64_t rows, depth;
    const float *a;
    int64_t by_row, by_depth;
    const float *x;
    float *y;
    int64_t step;
    const float *bias; /* [rows] to begin the sums with, or NULL */
    int add;           /* to what stands in y, rather than to the bias or 0 */
    int relu;
    const float *gate; /* as y, or NULL */
} product_t;

/* R rows from `row` on, N vectors from entry `at` on; U terms at once, each with sums of its own,
   since few sums wait for each other. Loops of at most 16 turns stay in registers: so they nest. */
INLINE void product_block(int R, int N, int U, const product_t *p, int64_t row, int64_t at) {
    const float *a = p->a + row * p->by_row, *x = p->x + at;
    const int64_t by_row = p->by_row, by_depth = p->by_depth, depth = p->depth;
    const int64_t step = p->step;
    float *y = p->y + row * step + at;
    vec sum[ROWS * ACROSS];
    for (int i = 0; i < U * R; i++)
        for (int j = 0; j < N; j++) sum[i * N + j] = (vec){0};
    int64_t k = 0;
    for (; k + U <= depth; k += U)
        for (int u = 0; u < U; u++) {
            vec terms[ACROSS];
            for (int j = 0; j < N; j++) terms[j] = LOAD(x + j * WIDTH);
            for (int i = 0; i < R; i++) {
                vec w = a[i * by_row] - (vec){0};
                for (int j = 0; j < N; j++) sum[(u * R + i) * N + j] += w * terms[j];
            }
            a += by_depth;
            x += TILE;
        }
    for (; k < depth; k++) {
        for (int i = 0; i < R; i++) {
            vec w = a[i * by_row] - (vec){0};
            for (int j = 0; j < N; j++) sum[i * N + j] += w * LOAD(x + j * WIDTH);
        }
        a += by_depth;
        x += TILE;
    }
    for (int i = R; i < U * R; i++)
        for (int j = 0; j < N; j++) sum[i % R * N + j] += sum[i * N + j];
    if (p->add)
        for (int i = 0; i < R; i++)
            for (int j = 0; j < N; j++) sum[i * N + j] += LOAD(y + i * step + j * WIDTH);
    else if (p->bias)
        for (int i = 0; i < R; i++)
            for (int j = 0; j < N; j++) sum[i * N + j] += p->bias[row + i];
    if (p->relu)
        for (int i = 0; i < R; i++)
            for (int j = 0; j < N; j++) sum[i * N + j] = positive(sum[i * N + j]);
    if (p->gate) {
        const float *gate = p->gate + row * step + at;
        for (int i = 0; i < R; i++)
            for (int j = 0; j < N; j++)
                sum[i * N + j] = where_positive(sum[i * N + j], LOAD(gate + i * step + j * WIDTH));
    }
    for (int i = 0; i < R; i++)
        for (int j = 0; j < N; j++) STORE(y + i * step + j * WIDTH, sum[i * N + j]);
}

/* At most ROWS rows, N vectors. */
INLINE void product_rows(int N, int64_t rows, const product_t *p, int64_t row, int64_t at) {
    switch (rows) {
    case 1: product_block(1, N, N > 2 ? 2 : 4, p, row, at); break;
    case 2: product_block(2, N, N > 2 ? 1 : 2, p, row, at); break;
    case 3: product_block(3, N, N > 1 ? 1 : 2, p, row, at); break;
    case 4: product_block(4, N, N > 1 ? 1 : 2, p, row, at); break;
    case 5: product_block(5, N, 1, p, row, at); break;
    default: product_block(6, N, 1, p, row, at);
    }
}

/* The whole product. */
static void product(int64_t vectors, const product_t *p) {
    for (int64_t row = 0; row < p->rows; row += ROWS) {
        int64_t rows = p->rows - row < ROWS ? p->rows - row : ROWS, j = 0;
        for (; j + ACROSS <= vectors; j += ACROSS) product_rows(ACROSS, rows, p, row, j * WIDTH);
#if ACROSS == 4
        if (vectors - j == 3) product_rows(3, rows, p, row, j * WIDTH);
        if (vectors - j == 2) product_rows(2, rows, p, row, j * WIDTH);
#endif
        if (vectors - j == 1) product_rows(1, rows, p, row, j * WIDTH);
    }
}

/* The same by parts of DEPTH terms. What ends the sums comes with the last part. */
static void deep_product(int64_t vectors, const product_t *whole) {
    int64_t done = 0;
    do {
        product_t p = *whole;
        int64_t left = p.depth - done;
        p.a += done * p.by_depth;
        p.x += done * TILE;
        p.add = p.add || done;
        p.depth = left;
        if (left > DEPTH) {
            p.depth = DEPTH;
            p.relu = 0;
            p.gate = NULL;
        }
        product(vectors, &p);
        done += p.depth;
    } while (done < whole->depth);
}

/* y[r] = bias[r] + sum over c of w[r, c] x[c]; negative results become 0 with `relu`.
   w: [rows, columns] by rows; bias may be NULL. A NaN stays one. */
static void dense_forward(int64_t vectors, int64_t rows, int64_t columns, const float *w,
                          const float *bias, int relu, const float *x, float *y) {
    deep_product(vectors, &(product_t){.rows = rows, .depth = columns, .a = w, .by_row = columns,
                                       .by_depth = 1, .x = x, .y = y, .step = TILE, .bias = bias,
                                       .relu = relu});
}

/* gx[c - first] = sum over r of w[r, c] g[r] for first <= c < last; 0 where gate[c - first] <= 0,
   if `gate` is given: a tile that begins with feature `first`, as gx does. */
static void dense_back(int64_t vectors, int64_t rows, int64_t columns, int64_t first, int64_t last,
                       const float *w, const float *g, const float *gate, float *gx) {
    deep_product(vectors, &(product_t){.rows = last - first, .depth = rows, .a = w + first,
                                       .by_row = 1, .by_depth = columns, .x = g, .y = gx,
                                       .step = TILE, .gate = gate});
}

/* grad[f * by_few + m * by_many] (+)= <a[f], b[m]>, eight m at once: pays where f are few. */
static void few_dots(int64_t vectors, int64_t few, int64_t many, const float *a, const float *b,
                     float *grad, int64_t by_few, int64_t by_many, int add) {
    for (int64_t m = 0; m < many; m += 8)
        for (int64_t f = 0; f < few; f++) {
            const float *from = a + f * TILE, *to = b + m * TILE;
            float *out = grad + f * by_few + m * by_many, result[8];
            int64_t some = many - m < 8 ? many - m : 8;
            if (some == 8) {
                vec sum[8] = {{0}};
                for (int64_t j = 0; j < vectors; j++) {
                    vec d = LOAD(from + j * WIDTH);
                    for (int q = 0; q < 8; q++) sum[q] += d * LOAD(to + q * TILE + j * WIDTH);
                }
                totals(sum, result, 0);
            } else
                for (int q = 0; q < some; q++) {
                    vec sum = {0};
                    for (int64_t j = 0; j < vectors; j++)
                        sum += LOAD(from + j * WIDTH) * LOAD(to + q * TILE + j * WIDTH);
                    result[q] = total(sum);
                }
            for (int q = 0; q < some; q++)
                out[q * by_many] = (add ? out[q * by_many] : 0) + result[q];
        }
}

/* grad[r, c] (+)= sum over the tile's entries of g[r] x[c]. grad: [rows, columns] by rows. */
static void dense_dots(int64_t vectors, int64_t rows, int64_t columns, const float *g,
                       const float *x, float *grad, int add) {
    float turned[TILE * TILE] __attribute__((aligned(64))); /* of x: [entries, columns] */
    int64_t whole = rows >= FEW ? columns / WIDTH * WIDTH : 0;
    for (int64_t c = 0; c < whole; c += TILE) {
        int64_t some = whole - c < TILE ? whole - c : TILE;
        transpose_all(x + c * TILE, some, vectors * WIDTH, TILE, turned, TILE);
        product(some / WIDTH, &(product_t){.rows = rows, .depth = vectors * WIDTH, .a = g,
                                           .by_row = TILE, .by_depth = 1, .x = turned,
                                           .y = grad + c, .step = columns, .add = add});
    }
    int64_t left = columns - whole;
    x += whole * TILE;
    grad += whole;
    if (rows < left)
        few_dots(vectors, rows, left, g, x, grad, columns, 1, add);
    else
        few_dots(vectors, left, rows, x, g, grad, 1, columns, add);
}

#undef ROWS
#undef ACROSS
#undef DEPTH
#undef FEW

#endif
