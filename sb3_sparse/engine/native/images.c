/* Passes of a batch through a chain of convolutions and poolings, forth and back. */
#include "activations.h"
#include "convolution.h"
#include "pooling.h"
#include "threads.h"

#include <stdlib.h>

/* One thread's share of a batch: the tiles [first, last). */
typedef struct {
    const images_t *images;
    const map_t *maps;
    const image_step_t *steps;
    const taps_t *taps, *turned;        /* of each step, by outputs and by inputs */
    int64_t first, last;
    float *scratch;
    float **value_grads, **bias_grads;  /* where this thread adds up, by step */
} share_t;

static int64_t entries_of(const images_t *images, int64_t tile) {
    int64_t left = images->batch - tile * LANES;
    return left < LANES ? left : LANES;
}

static float *memory_of(const share_t *share, const map_t *map, int64_t tile) {
    return map->kept ? share->images->kept + tile * share->images->kept_size + map->at
                     : share->scratch + map->at;
}

static plane_t map_of(const share_t *share, int64_t number, int64_t tile) {
    const map_t *map = share->maps + number;
    return plane_of(map, memory_of(share, map, tile), share->images->ring, LANES);
}

static plane_t grad_of(const share_t *share, int64_t number) {
    const map_t *map = share->maps + number;
    return plane_of(map, share->scratch + map->grad_at, share->images->grad_ring, LANES);
}

static void convolve(const share_t *share, const image_step_t *step, taps_t taps, int64_t tile, plane_t y,
                     plane_t copy) {
    const map_t *out = share->maps + step->out;
    plane_t x = map_of(share, step->in, tile), add = y;
    if (step->add >= 0) add = map_of(share, step->add, tile);
    for (int64_t i = 0; i < out->height; i++) {
        block_t row = {.in = x.at + (i * step->stride_y - step->padding_y) * x.row -
                             step->padding_x * LANES,
                       .in_step = step->stride_x * LANES,
                       .out = y.at + i * y.row,
                       .out_step = LANES,
                       .out_channel = y.channel,
                       .relu = step->activation == RELU};
        if (step->add >= 0) row.add = add.at + i * add.row, row.add_channel = add.channel;
        if (step->copy >= 0) row.copy = copy.at + i * copy.row;
        run_row(out->width, out->channels, taps, step->bias, &row);
        for (int64_t c = 0; c < out->channels && step->activation > RELU; c++) {
            float *at = y.at + c * y.channel + i * y.row, *to = copy.at + c * copy.channel + i * copy.row;
            activate(step->activation, (float)step->a, (float)step->b, at, out->width * LANES);
            for (int64_t n = 0; n < out->width * LANES && step->copy >= 0; n += WIDTH)
                STORE(to + n, positive(LOAD(at + n)));
        }
    }
}

/* Where the taps lie that a pooling takes; NULL where no backward pass follows. */
static int8_t *taken_of(const share_t *share, const image_step_t *step, int64_t tile) {
    const images_t *images = share->images;
    return images->kept ? (int8_t *)(images->kept + tile * images->kept_size + step->taken) : 0;
}

/* A map that is about to be written: its ring is 0. */
static plane_t begin(const share_t *share, int64_t number, int64_t tile) {
    const map_t *map = share->maps + number;
    clear_ring(map, memory_of(share, map, tile), share->images->ring, LANES);
    return map_of(share, number, tile);
}

static void forward_share(void *argument) {
    share_t *share = argument;
    const images_t *images = share->images;
    const image_step_t *end = share->steps + images->steps;
    const map_t *first = share->maps, *last = share->maps + end[-1].out;
    int64_t in = first->channels * first->height * first->width * LANES;
    int64_t out = last->channels * last->height * last->width * LANES;
    for (int64_t t = share->first; t < share->last; t++) {
        int64_t entries = entries_of(images, t);
        take_images(first, begin(share, 0, t), images->images_in + t * in, entries);
        for (const image_step_t *step = share->steps; step < end; step++) {
            plane_t y = begin(share, step->out, t), copy = y;
            if (step->copy >= 0) copy = begin(share, step->copy, t);
            if (step->kind == CONVOLUTION)
                convolve(share, step, share->taps[step - share->steps], t, y, copy);
            else
                pool(step, share->maps + step->in, share->maps + step->out, map_of(share, step->in, t), y, copy,
                     taken_of(share, step, t));
        }
        give_images(last, map_of(share, end[-1].out, t), images->images_out + t * out, entries);
    }
}

static int64_t modulo(int64_t a, int64_t b) { return (a % b + b) % b; }

/* The gradient of a convolution's input: stride_y * stride_x interleaved convolutions of the gradient of
   its output, each with the taps that meet its places. */
static void convolve_back(const share_t *share, const image_step_t *step, taps_t turned, int64_t tile) {
    const map_t *in = share->maps + step->source;
    plane_t g = grad_of(share, step->out), to = grad_of(share, step->source), gate = g;
    if (step->gate >= 0) gate = map_of(share, step->gate, tile);
    if (!step->adds) clear_ring(in, share->scratch + in->grad_at, share->images->grad_ring, LANES);
    for (int64_t a = 0; a < step->stride_y; a++)
        for (int64_t b = 0; b < step->stride_x; b++) {
            int64_t y0 = modulo(a - step->padding_y, step->stride_y);
            int64_t x0 = modulo(b - step->padding_x, step->stride_x);
            int64_t i = (y0 + step->padding_y - a) / step->stride_y;
            int64_t j = (x0 + step->padding_x - b) / step->stride_x;
            int64_t width = (in->width - x0 + step->stride_x - 1) / step->stride_x;
            for (int64_t y = y0; y < in->height && width > 0; y += step->stride_y, i++) {
                block_t row = {.in = g.at + i * g.row + j * LANES,
                               .in_step = LANES,
                               .out = to.at + y * to.row + x0 * LANES,
                               .out_step = step->stride_x * LANES,
                               .out_channel = to.channel};
                if (step->gate >= 0)
                    row.gate = gate.at + y * gate.row + x0 * LANES, row.gate_channel = gate.channel;
                if (step->adds) row.add = row.out, row.add_channel = to.channel;
                run_row(width, in->channels, turned, 0, &row);
            }
            turned.start += in->channels;
        }
}

static int goes_back(const share_t *share, const image_step_t *step) {
    return step->source || share->images->images_in_grad;
}

static void backward_share(void *argument) {
    share_t *share = argument;
    const images_t *images = share->images;
    const map_t *first = share->maps, *last = share->maps + share->steps[images->steps - 1].out;
    int64_t in = first->channels * first->height * first->width * LANES;
    int64_t result = last->channels * last->height * last->width * LANES;
    for (int64_t t = share->first; t < share->last; t++) {
        int64_t entries = entries_of(images, t), add = t > share->first;
        clear_ring(last, share->scratch + last->grad_at, images->grad_ring, LANES);
        take_images(last, grad_of(share, last - share->maps), images->images_out_grad + t * result, entries);
        for (int64_t n = images->steps - 1; n >= 0; n--) {
            const image_step_t *step = share->steps + n;
            const map_t *out = share->maps + step->out;
            if (step->kind == POOLING) {
                const map_t *source = share->maps + step->source;
                if (!goes_back(share, step)) continue;
                if (!step->adds)
                    memset(share->scratch + source->grad_at, 0,
                           size_of(source, images->grad_ring, LANES) * sizeof(float));
                pool_back(step, source, out, grad_of(share, step->out), grad_of(share, step->source),
                          taken_of(share, step, t));
                continue;
            }
            plane_t g = grad_of(share, step->out), y = map_of(share, step->out, t);
            if (step->add >= 0 && share->maps[step->add].grad_at != out->grad_at)
                memcpy(share->scratch + share->maps[step->add].grad_at, share->scratch + out->grad_at,
                       size_of(out, images->grad_ring, LANES) * sizeof(float));
            for (int64_t row = 0; row < out->channels * out->height && step->slope; row++) {
                int64_t c = row / out->height, i = row % out->height;
                slope(step->activation, (float)step->a, (float)step->b,
                      y.at + c * y.channel + i * y.row, g.at + c * g.channel + i * g.row, out->width * LANES);
            }
            if (share->value_grads[n]) {
                plane_t x = map_of(share, step->in, t);
                x.at -= step->padding_y * x.row + step->padding_x * LANES;
                dots(step, out, share->taps[n], x, g, share->value_grads[n], add);
            }
            if (share->bias_grads[n]) sums(out, g, share->bias_grads[n], add);
            if (step->output_grad)
                give_images(out, g, step->output_grad + t * LANES * out->channels * out->height * out->width,
                            entries);
            if (goes_back(share, step)) convolve_back(share, step, share->turned[n], t);
        }
        if (images->images_in_grad)
            give_images(first, grad_of(share, 0), images->images_in_grad + t * in, entries);
    }
}

static int64_t nnz_of(const image_step_t *step, const map_t *maps) {
    return step->kind == CONVOLUTION ? step->row_start[maps[step->out].channels] : 0;
}

/* Offsets of a convolution's connections in its input; returns the memory behind them. */
static int32_t *set_taps(const share_t *share, const image_step_t *step, taps_t *taps, int32_t *memory) {
    const map_t *in = share->maps + step->in;
    plane_t x = plane_of(in, 0, share->images->ring, LANES);
    int64_t nnz = nnz_of(step, share->maps), tap = 0;
    int32_t *offset = memory, *of_tap = memory + nnz;
    for (int64_t c = 0; c < in->channels; c++)
        for (int64_t r = 0; r < step->kernel_y; r++)
            for (int64_t s = 0; s < step->kernel_x; s++)
                of_tap[tap++] = (int32_t)(c * x.channel + r * x.row + s * LANES);
    for (int64_t k = 0; k < nnz; k++) offset[k] = of_tap[step->column[k]];
    *taps = (taps_t){step->row_start, offset, step->value};
    return of_tap; /* only the offsets of connections stay */
}

/* The same from the input's side, in the gradient of the output: by phases of the stride, then by channels. */
static int32_t *set_turned(const share_t *share, const image_step_t *step, taps_t *turned, int32_t *memory) {
    const map_t *in = share->maps + step->in;
    plane_t g = plane_of(share->maps + step->out, 0, share->images->grad_ring, LANES);
    int64_t nnz = nnz_of(step, share->maps), k = 0;
    int32_t *offset = memory, *start = memory + nnz, *next = start;
    float *value = (float *)(start + in->channels * step->stride_y * step->stride_x + 1);
    for (int64_t a = 0; a < step->stride_y; a++)
        for (int64_t b = 0; b < step->stride_x; b++)
            for (int64_t c = 0; c < in->channels; c++) {
                *next++ = (int32_t)k;
                for (int64_t r = a; r < step->kernel_y; r += step->stride_y)
                    for (int64_t s = b; s < step->kernel_x; s += step->stride_x) {
                        int64_t tap = (c * step->kernel_y + r) * step->kernel_x + s;
                        int64_t away = r / step->stride_y * g.row + s / step->stride_x * LANES;
                        for (int32_t at = step->column_start[tap]; at < step->column_start[tap + 1]; at++, k++) {
                            offset[k] = (int32_t)(step->row[at] * g.channel - away);
                            value[k] = step->value[step->position[at]];
                        }
                    }
            }
    *next = (int32_t)k;
    *turned = (taps_t){start, offset, value};
    return (int32_t *)(value + nnz);
}

/* Memory of a call: what threads need, the connections of every convolution, gradients of all threads but
   the first. */
static int run(void (*work)(void *), const images_t *images, const map_t *maps, const image_step_t *steps,
               int back) {
    share_t shares[MOST_SHARES];
    int64_t tiles = (images->batch + LANES - 1) / LANES, count = shares_of(tiles, images->threads);
    int64_t n = images->steps, size = 0, grads = 0;
    for (const image_step_t *step = steps; step < steps + n; step++) {
        if (step->kind != CONVOLUTION) continue;
        int64_t channels = maps[step->in].channels, nnz = nnz_of(step, maps);
        size += nnz + channels * step->kernel_y * step->kernel_x;
        if (back) size += 2 * nnz + channels * step->stride_y * step->stride_x + 1;
        grads += nnz + maps[step->out].channels;
    }
    size += count * images->scratch_size + (back ? (count - 1) * grads : 0);
    float *scratch = sb3_sparse_scratch((size * sizeof(float) + 63) / 64 * 64);
    taps_t *taps = malloc(2 * n * sizeof *taps);
    float **lists = malloc(2 * n * count * sizeof *lists), **list = lists;
    if (!scratch || !taps || !lists) {
        free(taps);
        free(lists);
        return -1;
    }
    int32_t *memory = (int32_t *)(scratch + count * images->scratch_size);
    for (int64_t i = 0; i < count; i++, scratch += images->scratch_size)
        shares[i] = (share_t){.images = images, .maps = maps, .steps = steps, .taps = taps,
                              .turned = taps + n, .first = tiles * i / count,
                              .last = tiles * (i + 1) / count, .scratch = scratch};
    for (int64_t l = 0; l < n; l++) {
        if (steps[l].kind != CONVOLUTION) continue;
        memory = set_taps(shares, steps + l, taps + l, memory);
        if (back && goes_back(shares, steps + l)) memory = set_turned(shares, steps + l, taps + n + l, memory);
    }
    float *next = (float *)memory;
    for (int64_t i = 0; i < count && back; i++, list += 2 * n) {
        shares[i].value_grads = list;
        shares[i].bias_grads = list + n;
        for (int64_t l = 0; l < n; l++) {
            list[l] = i && steps[l].value_grad ? next : steps[l].value_grad;
            next += i ? nnz_of(steps + l, maps) : 0;
            list[n + l] = i && steps[l].bias_grad ? next : steps[l].bias_grad;
            next += i && steps[l].kind == CONVOLUTION ? maps[steps[l].out].channels : 0;
        }
    }
    run_shares(work, shares, sizeof *shares, count);
    for (int64_t i = 1; i < count && back; i++)
        for (int64_t l = 0; l < n; l++) {
            const image_step_t *step = steps + l;
            int64_t nnz = nnz_of(step, maps), channels = maps[step->out].channels;
            if (step->value_grad) add_to(step->value_grad, shares[i].value_grads[l], nnz);
            if (step->bias_grad) add_to(step->bias_grad, shares[i].bias_grads[l], channels);
        }
    free(taps);
    free(lists);
    return 0;
}

int NAMED(images_forward, SUFFIX)(const images_t *images, const map_t *maps, const image_step_t *steps) {
    return run(forward_share, images, maps, steps, 0);
}

int NAMED(images_backward, SUFFIX)(const images_t *images, const map_t *maps, const image_step_t *steps) {
    return run(backward_share, images, maps, steps, 1);
}
