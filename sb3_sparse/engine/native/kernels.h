/* Products of a chain of sparse linear layers with a batch of inputs.
 *
 * Compiled once for each instruction set with SUFFIX set (see dispatch.c); float32 throughout.
 *
 * Activations are held in tiles: [batch / TILE, features, TILE], so that what one connection does to
 * TILE batch entries is a broadcast and a few multiply-adds on contiguous memory. A tile goes
 * through all layers before the next one begins. The entries that fill up the last tile are zeros
 * at the input, and no gradient flows through them.
 */
#ifndef SB3_SPARSE_KERNELS_H
#define SB3_SPARSE_KERNELS_H

#include <stdint.h>

#define TILE 64

/* One layer, y = relu(W x + b). All fields are 8 bytes wide; Python fills them in this order. */
typedef struct {
    int64_t rows;                /* outputs */
    int64_t columns;             /* inputs */
    int64_t relu;                /* whether a ReLU follows */
    const int32_t *row_start;    /* [rows + 1]: where each row's connections begin */
    const int32_t *column;       /* [nnz] */
    const int32_t *column_start; /* [columns + 1]: the same by columns */
    const int32_t *row;          /* [nnz] */
    const int32_t *position;     /* [nnz]: where the connection stands by rows */
    const float *value;          /* [nnz] by rows */
    const float *bias;           /* [rows], or NULL */
    float *output;               /* [tiles, rows, TILE] */
    float *value_grad;           /* [nnz], or NULL where not wanted */
    float *bias_grad;            /* [rows], or NULL */
    float *output_grad;          /* [tiles, rows, TILE] to leave the gradient of W x + b in, or NULL */
} layer_t;

/* A batch going through a chain. */
typedef struct {
    int64_t layers;
    int64_t batch;
    int64_t threads;
    float *input;         /* [tiles, columns of the first layer, TILE] */
    const float *rows_in; /* [batch, columns of the first layer] to fill `input` with, or NULL */
    float *rows_out;      /* [batch, rows of the last layer] to write the result to, or NULL */
    /* backward only */
    const float *rows_grad;  /* gradient of the result: [batch, rows of the last layer], or NULL */
    const float *tiles_grad; /* the same in tiles, where rows_grad is NULL */
    float *rows_input_grad;  /* [batch, columns of the first layer], or NULL */
    float *tiles_input_grad; /* the same in tiles, or NULL */
} batch_t;

/* OpenMP as the process has it already: GOMP_parallel, omp_get_thread_num, omp_get_num_threads.
   A second pool of threads would fight with the one that waits, spinning, for torch's next call. */
typedef struct {
    void (*parallel)(void (*)(void *), void *, unsigned, unsigned);
    int (*thread)(void);
    int (*threads)(void);
} openmp_t;
extern openmp_t sb3_sparse_openmp;

#define JOIN(name, suffix) name##_##suffix
#define NAMED(name, suffix) JOIN(name, suffix)

#define DECLARE(suffix)                                                    \
    void NAMED(forward, suffix)(const layer_t *, const batch_t *);         \
    int NAMED(backward, suffix)(const layer_t *, const batch_t *);         \
    void NAMED(single, suffix)(const layer_t *, const float *, float *);

#endif
