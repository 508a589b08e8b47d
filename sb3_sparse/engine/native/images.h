/* Images going through a chain of sparse convolutions and poolings.
 *
 * What lies between two steps is a map: [tiles, channels, rows, columns, LANES], LANES images to a
 * tile, so that what one connection does to LANES images at one place is one multiply-add on
 * contiguous memory, wherever the place is. A ring of zeros around each channel stands for the
 * padding, so no kernel has edges. A tile goes through all steps before the next one begins.
 *
 * All fields are 8 bytes wide; Python fills them in this order.
 */
#ifndef SB3_SPARSE_IMAGES_H
#define SB3_SPARSE_IMAGES_H

#include "kernels.h"

/* A map of one tile. Places are counted in numbers from the start of a tile's memory. */
typedef struct {
    int64_t channels, height, width;
    int64_t kept;    /* whether the backward pass reads it: then its memory is the batch's, else a thread's */
    int64_t at;      /* place in that memory */
    int64_t grad_at; /* place of its gradient in the memory of a thread; -1: it has none */
} map_t;

/* One step: out = f(W in + b), or W in + b + add, or the largest of each window; copy = max(out, 0). */
typedef struct {
    int64_t kind;
    int64_t in;     /* numbers of maps, as all up to `gate`; -1: there is none */
    int64_t source; /* the map whose gradient this step gives: `in`, or what `in` is a copy of */
    int64_t out, add, copy;
    int64_t gate;  /* a map: the gradient of `source` counts where it is positive */
    int64_t adds;  /* whether the gradient of `source` has begun, so that this step's is added */
    int64_t slope; /* whether the backward pass begins with the activation's slope */
    int64_t kernel_y, kernel_x, stride_y, stride_x, padding_y, padding_x;
    int64_t taken;         /* of a pooling: place of the taps it took, a byte each, in kept memory */
    int64_t activation;    /* one whose slope its result tells */
    double a, b;           /* its parameters */
    const int32_t *row_start, *column, *column_start, *row, *position; /* as in layer_t; a column
                              is a tap of a channel: (channel * kernel_y + y) * kernel_x + x */
    const float *value;    /* [nnz] by rows */
    const float *bias;     /* [rows], or NULL */
    float *value_grad;     /* [nnz], or NULL where not wanted */
    float *bias_grad;      /* [rows], or NULL */
    float *output_grad;    /* [batch, rows, height, width] to leave the gradient of W in + b in, or NULL */
} image_step_t;
enum { CONVOLUTION, POOLING };

typedef struct {
    int64_t steps, maps, batch, threads;
    int64_t ring, grad_ring;          /* zeros around each channel of a map, and of its gradient */
    int64_t kept_size, scratch_size;  /* numbers of a tile, and of a thread */
    float *kept;                      /* [tiles, kept_size], or NULL where no backward pass follows */
    const float *images_in;           /* [batch, channels, height, width] of map 0 */
    float *images_out;                /* the same of the last step's map */
    /* backward only */
    const float *images_out_grad;
    float *images_in_grad;            /* or NULL */
} images_t;

#define DECLARE_IMAGES(suffix)                                                              \
    int NAMED(images_forward, suffix)(const images_t *, const map_t *, const image_step_t *); \
    int NAMED(images_one_by_one, suffix)(const images_t *, const map_t *, const image_step_t *); \
    int NAMED(images_backward, suffix)(const images_t *, const map_t *, const image_step_t *);

#endif
