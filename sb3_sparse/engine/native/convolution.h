/* Products of a sparse convolution: by its input, and by its weights. */
#ifndef SB3_SPARSE_CONVOLUTION_H
#define SB3_SPARSE_CONVOLUTION_H

#include "maps.h"

#define PARTS (LANES / WIDTH) /* vectors to a place of a map */
#if WIDTH == 16
#define PLACES 14 /* places of a row that registers hold at once */
#elif WIDTH == 8 || defined(__aarch64__)
#define PLACES 6
#else
#define PLACES 3
#endif

#define DOTS_PLACES 64 /* places of an output that a round of dot products covers, about */

/* The connections of a convolution as offsets: of an output's, in the input and its ring. */
typedef struct {
    const int32_t *start, *offset;
    const float *value;
} taps_t;

/* What a block of a product reads and writes; every pointer is to its first place in channel 0. */
typedef struct {
    const float *in;
    int64_t in_step; /* numbers from a place to the next */
    float *out;
    int64_t out_step, out_channel;
    int relu;
    const float *gate; /* where the result counts: where this is positive, or NULL */
    int64_t gate_channel;
    const float *add;
    int64_t add_channel;
    float *copy; /* gets the positive part, or NULL */
} block_t;

/* `places` places of all `outputs` channels: a sum over connections each. */
INLINE void block_of(int places, int64_t in_step, int64_t outputs, taps_t taps, const float *bias,
                     const block_t *block) {
    for (int64_t o = 0; o < outputs; o++) {
        vec sum[PLACES * PARTS];
        for (int i = 0; i < places * PARTS; i++) sum[i] = (bias ? bias[o] : 0) + (vec){0};
        for (int32_t k = taps.start[o]; k < taps.start[o + 1]; k++) {
            const float *from = block->in + taps.offset[k];
            vec w = taps.value[k] - (vec){0};
            for (int i = 0; i < places; i++) {
                ADDRESS(from);
                for (int j = 0; j < PARTS; j++)
                    sum[i * PARTS + j] += w * LOAD(from + (in_step == LANES ? i * LANES : 0) + j * WIDTH);
                if (in_step != LANES) from += in_step;
            }
        }
        int64_t at = o * block->out_channel;
        for (int i = 0; i < places; i++)
            for (int j = 0; j < PARTS; j++) {
                int64_t place = i * block->out_step + j * WIDTH;
                vec s = sum[i * PARTS + j];
                if (block->relu) s = positive(s);
                if (block->gate)
                    s = where_positive(s, LOAD(block->gate + o * block->gate_channel + place));
                if (block->add) s += LOAD(block->add + o * block->add_channel + place);
                STORE(block->out + at + place, s);
                if (block->copy) STORE(block->copy + at + place, positive(s));
            }
    }
}

static void run_block(int64_t places, int64_t outputs, taps_t taps, const float *bias,
                      const block_t *block) {
#define CASE(N)                                                      \
    case N:                                                          \
        if (block->in_step == LANES)                                 \
            block_of(N, LANES, outputs, taps, bias, block);          \
        else                                                         \
            block_of(N, block->in_step, outputs, taps, bias, block); \
        break;
    switch (places) {
        CASE(1) CASE(2) CASE(3)
#if PLACES > 3
        CASE(4) CASE(5) CASE(6)
#endif
#if PLACES > 6
        CASE(7) CASE(8) CASE(9) CASE(10) CASE(11) CASE(12) CASE(13) CASE(14)
#endif
    }
#undef CASE
}

/* A row of `width` places in blocks of about equal size. */
static void run_row(int64_t width, int64_t outputs, taps_t taps, const float *bias, const block_t *row) {
    int64_t blocks = (width + PLACES - 1) / PLACES;
    for (int64_t b = 0; b < blocks; b++) {
        int64_t first = width * b / blocks, last = width * (b + 1) / blocks;
        block_t block = *row;
        block.in += first * row->in_step;
        block.out += first * row->out_step;
        if (block.gate) block.gate += first * row->out_step;
        if (block.add) block.add += first * row->out_step;
        if (block.copy) block.copy += first * row->out_step;
        run_block(last - first, outputs, taps, bias, &block);
    }
}

/* grad[0..count) (+)= sums over places of a few rows of an output's gradient times `count` inputs. */
INLINE void dots_of(int count, int64_t rows, int64_t places, const float *g, int64_t g_row, const float *x,
                    int64_t x_row, int64_t x_step, const int32_t *offset, float *grad, int add) {
    vec sum[8];
    for (int q = 0; q < count; q++) sum[q] = (vec){0};
    for (int64_t i = 0; i < rows; i++, g += g_row, x += x_row) {
        const float *to[8];
        for (int q = 0; q < count; q++) to[q] = x + offset[q];
        for (int64_t j = 0; j < places; j++)
            for (int part = 0; part < LANES; part += WIDTH) {
                vec d = LOAD(g + j * LANES + part);
                for (int q = 0; q < count; q++) sum[q] += d * LOAD(to[q] + j * x_step + part);
            }
    }
    if (count == 8)
        totals(sum, grad, add);
    else
        for (int q = 0; q < count; q++) grad[q] = (add ? grad[q] : 0) + total(sum[q]);
}

/* grad[k] (+)= sum over places of g[output of k] * x at the connection's offset. */
static inline void dots(const image_step_t *step, const map_t *out, taps_t taps, plane_t x, plane_t g,
                        float *grad, int add) {
    int64_t most = DOTS_PLACES / out->width > 1 ? DOTS_PLACES / out->width : 1;
    int64_t x_row = step->stride_y * x.row, x_step = step->stride_x * LANES;
    for (int64_t i = 0; i < out->height; i += most, add = 1) {
        int64_t rows = i + most < out->height ? most : out->height - i;
        for (int64_t o = 0; o < out->channels; o++) {
            const float *d = g.at + o * g.channel + i * g.row, *from = x.at + i * x_row;
            for (int32_t k = taps.start[o], count; k < taps.start[o + 1]; k += count) {
                count = taps.start[o + 1] - k;
#define CASE(N)                                                                                    \
    case N: dots_of(N, rows, out->width, d, g.row, from, x_row, x_step, taps.offset + k, grad + k, add); break;
                switch (count) {
                    CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7)
                default:
                    count = 8;
                    dots_of(8, rows, out->width, d, g.row, from, x_row, x_step, taps.offset + k, grad + k, add);
                }
#undef CASE
            }
        }
    }
}

static inline void sums(const map_t *out, plane_t g, float *grad, int add) {
    for (int64_t o = 0; o < out->channels; o++) {
        vec sum[4] = {{0}}; /* of neighbours, whose sums do not wait for each other */
        for (int64_t i = 0; i < out->height; i++)
            for (int64_t j = 0, q = 0; j < out->width * LANES; j += WIDTH, q = (q + 1) & 3)
                sum[q] += LOAD(g.at + o * g.channel + i * g.row + j);
        grad[o] = (add ? grad[o] : 0) + total((sum[0] + sum[1]) + (sum[2] + sum[3]));
    }
}

#endif
