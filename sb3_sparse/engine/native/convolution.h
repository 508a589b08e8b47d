/* Products of a sparse convolution: sums over connections for a few places at once. */
#ifndef SB3_SPARSE_CONVOLUTION_H
#define SB3_SPARSE_CONVOLUTION_H

#include "images.h"
#include "vectors.h"

#define PARTS (LANES / WIDTH) /* vectors to a place of a map */
#if WIDTH == 16
#define PLACES 14 /* places of a row that registers hold at once */
#elif WIDTH == 8 || defined(__aarch64__)
#define PLACES 6
#else
#define PLACES 3
#endif

/* Keeps a compiler from spending a register on the address of each place. */
#if defined(__GNUC__)
#define ADDRESS(p) __asm__("" : "+r"(p))
#else
#define ADDRESS(p) (void)(p)
#endif

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
#define CASE(N)                                                                    \
    case N:                                                                        \
        if (block->in_step == LANES)                                               \
            block_of(N, LANES, outputs, taps, bias, block);                        \
        else                                                                       \
            block_of(N, block->in_step, outputs, taps, bias, block);               \
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

#endif
