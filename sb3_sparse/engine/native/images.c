/* Passes of a batch through a chain of convolutions and poolings, forth and back. */
#include "activations.h"
#include "convolution.h"
#include "maps.h"
#include "threads.h"

#include <stdlib.h>

#define DOTS_PLACES 64 /* places of an output that a round of dot products covers, about */

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

/* Images [batch, channels, height, width] to and from a tile's map; lanes without an image are 0. */
static void take_images(const map_t *map, plane_t to, const float *images, int64_t entries) {
    int64_t size = map->height * map->width, stride = map->channels * size;
    for (int64_t c = 0; c < map->channels; c++)
        for (int64_t y = 0; y < map->height; y++) {
            float *row = to.at + c * to.channel + y * to.row;
            transpose_all(images + c * size + y * map->width, entries, map->width, stride, row, LANES);
            for (int64_t x = 0; x < map->width && entries < LANES; x++)
                memset(row + x * LANES + entries, 0, (LANES - entries) * sizeof *row);
        }
}

static void give_images(const map_t *map, plane_t from, float *images, int64_t entries) {
    int64_t size = map->height * map->width, stride = map->channels * size;
    for (int64_t c = 0; c < map->channels; c++)
        for (int64_t y = 0; y < map->height; y++)
            transpose_all(from.at + c * from.channel + y * from.row, map->width, entries, LANES,
                          images + c * size + y * map->width, stride);
}

static void convolve(const share_t *share, const image_step_t *step, taps_t taps, int64_t tile) {
    const map_t *out = share->maps + step->out;
    plane_t x = map_of(share, step->in, tile), y = map_of(share, step->out, tile);
    plane_t add = step->add < 0 ? y : map_of(share, step->add, tile);
    plane_t copy = step->copy < 0 ? y : map_of(share, step->copy, tile);
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

/* The first largest number of each window, in torch's order; a NaN counts as largest. */
static void pool(const share_t *share, const image_step_t *step, int64_t tile) {
    const map_t *in = share->maps + step->in, *out = share->maps + step->out;
    plane_t x = map_of(share, step->in, tile), y = map_of(share, step->out, tile);
    plane_t copy = step->copy < 0 ? y : map_of(share, step->copy, tile);
    int8_t *taken = 0;
    if (share->images->kept)
        taken = (int8_t *)(share->images->kept + tile * share->images->kept_size + step->taken);
    for (int64_t c = 0; c < out->channels; c++)
        for (int64_t i = 0; i < out->height; i++)
            for (int64_t j = 0; j < out->width; j++) {
                int64_t top = i * step->stride_y - step->padding_y, left = j * step->stride_x - step->padding_x;
                int64_t to = c * y.channel + i * y.row + j * LANES;
                int64_t r0 = top < 0 ? -top : 0, s0 = left < 0 ? -left : 0;
                for (int part = 0; part < LANES; part += WIDTH) {
                    vec best = -INFINITY + (vec){0};
                    ivec which = (int32_t)(r0 * step->kernel_x + s0) + (ivec){0};
                    for (int64_t r = r0; r < step->kernel_y && top + r < in->height; r++)
                        for (int64_t s = s0; s < step->kernel_x && left + s < in->width; s++) {
                            vec v = LOAD(x.at + c * x.channel + (top + r) * x.row + (left + s) * LANES + part);
                            ivec more = (v > best) | (v != v);
                            best = choose(more, v, best);
                            which = (more & (int32_t)(r * step->kernel_x + s)) | (~more & which);
                        }
                    STORE(y.at + to + part, best);
                    if (step->copy >= 0) STORE(copy.at + to + part, positive(best));
                    for (int lane = 0; lane < WIDTH && taken; lane++) *taken++ = (int8_t)which[lane];
                }
            }
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
            begin(share, step->out, t);
            if (step->copy >= 0) begin(share, step->copy, t);
            if (step->kind == CONVOLUTION)
                convolve(share, step, share->taps[step - share->steps], t);
            else
                pool(share, step, t);
        }
        give_images(last, map_of(share, end[-1].out, t), images->images_out + t * out, entries);
    }
}

/* grad[k] (+)= sum over places of g[output of k] * x at the connection's offset. */
static void dots(const image_step_t *step, const map_t *out, taps_t taps, plane_t x, plane_t g,
                 float *grad, int add) {
    int64_t rows = DOTS_PLACES / out->width, places = out->width, in_step = step->stride_x * LANES;
    if (rows < 1) rows = 1;
    for (int64_t i = 0; i < out->height; i += rows) {
        int64_t end = i + rows < out->height ? i + rows : out->height;
        for (int64_t o = 0; o < out->channels; o++) {
            int32_t k = taps.start[o], last = taps.start[o + 1];
            const float *from = g.at + o * g.channel;
            for (; k + 8 <= last; k += 8) {
                vec sum[8];
                for (int q = 0; q < 8; q++) sum[q] = (vec){0};
                for (int64_t y = i; y < end; y++) {
                    const float *d = from + y * g.row, *base = x.at + y * step->stride_y * x.row, *to[8];
                    for (int q = 0; q < 8; q++) to[q] = base + taps.offset[k + q];
                    for (int64_t j = 0; j < places; j++)
                        for (int part = 0; part < LANES; part += WIDTH) {
                            vec v = LOAD(d + j * LANES + part);
                            for (int q = 0; q < 8; q++) sum[q] += v * LOAD(to[q] + j * in_step + part);
                        }
                }
                totals(sum, grad + k, add || i);
            }
            for (; k < last; k++) {
                vec sum = {0};
                for (int64_t y = i; y < end; y++) {
                    const float *d = from + y * g.row;
                    const float *to = x.at + y * step->stride_y * x.row + taps.offset[k];
                    for (int64_t j = 0; j < places; j++)
                        for (int part = 0; part < LANES; part += WIDTH)
                            sum += LOAD(d + j * LANES + part) * LOAD(to + j * in_step + part);
                }
                grad[k] = (add || i ? grad[k] : 0) + total(sum);
            }
        }
    }
}

static void sums(const map_t *out, plane_t g, float *grad, int add) {
    for (int64_t o = 0; o < out->channels; o++) {
        vec sum[4] = {{0}}; /* of neighbours, whose sums do not wait for each other */
        for (int64_t i = 0; i < out->height; i++)
            for (int64_t j = 0, q = 0; j < out->width * LANES; j += WIDTH, q = (q + 1) & 3)
                sum[q] += LOAD(g.at + o * g.channel + i * g.row + j);
        grad[o] = (add ? grad[o] : 0) + total((sum[0] + sum[1]) + (sum[2] + sum[3]));
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

static void pool_back(const share_t *share, const image_step_t *step, int64_t tile) {
    const map_t *in = share->maps + step->source, *out = share->maps + step->out;
    plane_t g = grad_of(share, step->out), to = grad_of(share, step->source);
    const int8_t *taken =
        (const int8_t *)(share->images->kept + tile * share->images->kept_size + step->taken);
    if (!step->adds)
        memset(share->scratch + in->grad_at, 0, size_of(in, share->images->grad_ring, LANES) * sizeof(float));
    for (int64_t c = 0; c < out->channels; c++)
        for (int64_t i = 0; i < out->height; i++)
            for (int64_t j = 0; j < out->width; j++) {
                int64_t top = i * step->stride_y - step->padding_y;
                int64_t left = j * step->stride_x - step->padding_x;
                for (int part = 0; part < LANES; part += WIDTH, taken += WIDTH) {
                    vec d = LOAD(g.at + c * g.channel + i * g.row + j * LANES + part);
                    ivec which;
                    for (int lane = 0; lane < WIDTH; lane++) which[lane] = taken[lane];
                    for (int64_t r = top < 0 ? -top : 0; r < step->kernel_y && top + r < in->height; r++)
                        for (int64_t s = left < 0 ? -left : 0; s < step->kernel_x && left + s < in->width; s++) {
                            float *at = to.at + c * to.channel + (top + r) * to.row + (left + s) * LANES + part;
                            ivec here = which == (int32_t)(r * step->kernel_x + s);
                            STORE(at, LOAD(at) + (vec)(here & (ivec)d));
                        }
                }
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
                if (goes_back(share, step)) pool_back(share, step, t);
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
            for (int64_t k = 0; steps[l].value_grad && k < nnz_of(steps + l, maps); k++)
                steps[l].value_grad[k] += shares[i].value_grads[l][k];
            for (int64_t r = 0; steps[l].bias_grad && r < maps[steps[l].out].channels; r++)
                steps[l].bias_grad[r] += shares[i].bias_grads[l][r];
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
