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

#include <stddef.h>
#include <stdint.h>

#define TILE 64
#define LANES 16      /* of a small batch, and of images; image_layout.py has the same number */
#define MOST_STEPS 64 /* of networks that act */

/* One layer, y = f(W x + b). All fields are 8 bytes wide; Python fills them in this order. */
typedef struct {
    int64_t rows;                /* outputs */
    int64_t columns;             /* inputs */
    int64_t activation;          /* what follows: one whose slope its result tells */
    double a, b;                 /* its parameters */
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

/* Elementwise functions that may follow a layer when it acts. `a` and `b` are their parameters. */
enum {
    IDENTITY,
    RELU,
    TANH,
    SIGMOID,
    ELU,       /* a: factor of the negative part */
    CELU,      /* a: alpha */
    SELU,
    GELU,
    GELU_TANH, /* by its tanh approximation */
    SILU,
    MISH,
    SOFTPLUS,  /* a: beta, b: threshold */
    LEAKY_RELU, /* a: negative slope */
    HARDTANH,  /* a: least, b: most */
    HARDSWISH,
};

/* One layer of networks that act on up to LANES inputs. All fields are 8 bytes wide. */
typedef struct {
    int64_t rows, columns;
    const int32_t *row_start; /* [rows + 1], or NULL where the weights are dense */
    const int32_t *column;    /* [nnz] */
    const float *value;       /* [nnz] by rows, or dense: [rows, columns] */
    const float *mask;        /* of dense weights, 0 where they do not count; or NULL */
    const float *bias;        /* [rows], or NULL */
    int64_t activation;
    double a, b;
    int64_t from; /* number of the step whose result is the input; -1: the observations */
    int64_t out;  /* feature of `y` at which the result [batch, rows] begins; -1: nobody reads it */
    double epsilon;     /* of the norm of the input; negative: there is none */
    const float *scale; /* [columns] of the norm, or NULL */
    const float *shift; /* [columns], or NULL */
    const float *mean, *variance; /* [columns] by which it normalises; NULL: it is a LayerNorm */
    int64_t add; /* number of the step whose result is added; -1: the observations; -2: nothing */
} step_t;

/* OpenMP as the process has it already: GOMP_parallel, omp_get_thread_num, omp_get_num_threads.
   A second pool of threads would fight with the one that waits, spinning, for torch's next call. */
typedef struct {
    void (*parallel)(void (*)(void *), void *, unsigned, unsigned);
    int (*thread)(void);
    int (*threads)(void);
} openmp_t;
extern openmp_t sb3_sparse_openmp;

/* Memory of this thread that stays for the next call: new pages cost as much as the products.
   The address sanitizer gets exact sizes instead. `size` is a multiple of 64; NULL if there is none. */
float *sb3_sparse_scratch(size_t size);

#define JOIN(name, suffix) name##_##suffix
#define NAMED(name, suffix) JOIN(name, suffix)

#define DECLARE(suffix)                                                    \
    void NAMED(forward, suffix)(const layer_t *, const batch_t *);         \
    int NAMED(backward, suffix)(const layer_t *, const batch_t *);         \
    int NAMED(act, suffix)(const step_t *, int64_t, int64_t, int, const void *, float *);

#endif
