/* A gradient step as a program: a list of operations that one call runs.
 *
 * Values lie in tiles (see kernels.h). A batched value has [tiles, features, TILE] numbers. One that
 * the whole batch shares has [features, TILE], of which the first vector is in use, with all lanes
 * equal; among tiled operations, only the kinds up to FILL read it. Operations marked `tiled`
 * that follow each other are a phase: a tile goes through all of them before the next one begins, and
 * threads share the tiles. All others run once, on one thread, between phases.
 *
 * All fields are 8 bytes wide; Python fills them in this order.
 */
#ifndef SB3_SPARSE_FUSED_H
#define SB3_SPARSE_FUSED_H

#include "kernels.h"

/* An operand: where its first number is, and how far apart threads, tiles and features are (0: the
   same). What a phase alone needs has room for one tile of each thread. */
typedef struct {
    float *base;
    int64_t thread, tile, feature;
} place_t;

/* A linear layer. `row_start` is NULL where its weight is read as a dense matrix. */
typedef struct {
    int64_t rows, columns;
    const int32_t *row_start, *column, *column_start, *row, *position; /* as in layer_t */
    float *value;       /* [nnz] by rows, or the dense weight */
    const float *bias;  /* [rows], or NULL */
    float *turned;      /* [nnz]: the values by columns */
    float *weight_grad; /* as many as `value`; each further thread has its own `per_thread` behind */
    float *bias_grad;
    float *dense_grad;  /* [rows, columns]: where a capturing operation adds up, or NULL */
} linear_t;

/* What an optimizer moves. */
typedef struct {
    int64_t count;        /* of numbers that move */
    float *number;        /* torch's own tensor */
    const int32_t *flat;  /* [count]: which of its numbers they are; NULL: the first `count` */
    const float *mask;    /* 0 where a number stays 0, or NULL */
    float *packed;        /* [count]: a copy that layers compute with, or NULL */
    float *grad;          /* [count] */
    float *first, *second; /* moments, torch's own */
    float *steps;         /* torch's counter */
    int64_t group;
    double decay;         /* coupled L2 of this parameter */
} parameter_t;

/* Settings of an optimizer's parameter group. */
typedef struct {
    int64_t optimizer; /* ADAM, ... */
    double rate, beta1, beta2, epsilon, decay;
    int64_t decoupled; /* whether `decay` is AdamW's */
} group_t;
enum { ADAM, RMSPROP, RMSPROP_TF /* epsilon within the root */ };

/* Rows [batch, features] that come from outside. */
typedef struct {
    const void *rows;
    int64_t type;         /* FLOAT32, ... */
    int64_t stride;       /* from row to row, in numbers */
    const int64_t *index; /* [batch]: which rows, or NULL: the first ones */
} input_t;
enum { FLOAT32, FLOAT64, INT64, INT32, UINT8, INT8 };

typedef struct {
    int64_t kind, tiled;
    place_t to, a, b, c;
    int64_t features;     /* of the result */
    int64_t first, last;  /* columns, parameters, ... */
    int64_t number;       /* of a layer, parameter or input; or an activation */
    double p, q;          /* parameters of an activation, or a factor */
} operation_t;

typedef struct {
    const operation_t *operations;
    const linear_t *layers;
    const parameter_t *parameters;
    const group_t *groups;
    const input_t *inputs;
    int64_t batch, threads;
    int64_t per_thread;   /* numbers between the gradients of two threads */
} program_t;

/* Kinds of operations. Python has the same list. */
enum {
    /* elementwise: to = f(a, b, c); up to FILL, those that read what the whole batch shares */
    COPY, ADD, SUBTRACT, MULTIPLY, MULTIPLY_ADD, DIVIDE, LEAST, /* b where it is less than a, else a */
    LESS, SAME, CLAMP, INSIDE,                    /* of a between b and c */
    EXP, LOG, SQRT, ABS, HUBER,                   /* smooth L1 of a */
    SLOPE_INPUT,                                  /* a * slope at b */
    FILL,                                         /* a, but 0 beyond the batch */
    ACTIVATION, SLOPE_RESULT,
    /* over features */
    SUM_FEATURES, MAX_FEATURES, PICK, PUT, ARGMAX, SORT, QUANTILE_HUBER,
    /* layers and inputs */
    LOAD_ROWS, LINEAR, LINEAR_BACK, LINEAR_GRAD, LINEAR_DENSE_GRAD,
    /* once */
    SUM_BATCH, MEAN_BATCH, DOT_BATCH, CHECK, SPREAD, EXPORT, STORE, PACK, TURN, MASK_GRADS,
    CLIP_NORM, OPTIMIZE, POLYAK,
};

#define DECLARE_FUSED(suffix) \
    int64_t NAMED(fused, suffix)(const program_t *, int64_t, int64_t);

#endif
