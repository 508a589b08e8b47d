/* Images that pass a chain one at a time, nothing kept, as in a rollout.
 *
 * A map of one image is [channels, rows, columns] in its ring. Vectors lie along it and run on across the
 * ends of its rows: a connection is the same distance away at each place, and what a product computes
 * between the rows is dropped. The input of a convolution with a stride is dealt out first, into
 * stride_y * stride_x images of every stride-th row and column each.
 */
#include "activations.h"
#include "convolution.h"
#include "threads.h"

#include <stdlib.h>

/* Of one convolution: rows and columns of a dealt-out image, numbers of a channel and of a result. */
typedef struct {
    int64_t height, width, channel, result;
    taps_t taps;
} view_t;

typedef struct {
    const images_t *images;
    const map_t *maps;
    const image_step_t *steps;
    const view_t *views;
    int64_t first, last;
    float *scratch, *dealt, *result;
} share_t;

static plane_t map_of(const share_t *share, int64_t number) {
    const map_t *map = share->maps + number;
    return plane_of(map, share->scratch + map->at / LANES, share->images->ring, 1);
}

static plane_t begin(const share_t *share, int64_t number) {
    const map_t *map = share->maps + number;
    clear_ring(map, share->scratch + map->at / LANES, share->images->ring, 1);
    return map_of(share, number);
}

static int strides(const image_step_t *step) { return step->stride_y > 1 || step->stride_x > 1; }

static view_t view_of(const images_t *images, const map_t *maps, const image_step_t *step) {
    const map_t *in = maps + step->in, *out = maps + step->out;
    view_t view = {0};
    if (strides(step)) {
        view.height = (in->height + 2 * step->padding_y + step->stride_y - 1) / step->stride_y;
        view.width = (in->width + 2 * step->padding_x + step->stride_x - 1) / step->stride_x;
        view.channel = step->stride_y * step->stride_x * view.height * view.width;
    } else {
        view.width = in->width + 2 * images->ring;
        view.channel = (in->height + 2 * images->ring) * view.width;
    }
    int64_t places = (out->height - 1) * view.width + out->width;
    view.result = (places + LANES - 1) / LANES * LANES;
    return view;
}

static void deal_out(const share_t *share, const image_step_t *step, const view_t *view) {
    const map_t *in = share->maps + step->in;
    plane_t x = map_of(share, step->in);
    float *to = share->dealt;
    for (int64_t c = 0; c < in->channels; c++)
        for (int64_t a = 0; a < step->stride_y; a++)
            for (int64_t b = 0; b < step->stride_x; b++)
                for (int64_t i = 0; i < view->height; i++, to += view->width) {
                    int64_t y = i * step->stride_y + a - step->padding_y, left = b - step->padding_x;
                    int64_t count = (in->width - left + step->stride_x - 1) / step->stride_x; /* up to the end */
                    const float *from = x.at + c * x.channel + y * x.row + left;
                    if (y < 0 || y >= in->height) count = 0; /* the ring's rows, and what is behind them */
                    if (count > view->width) count = view->width;
                    for (int64_t j = 0; j < count; j++) to[j] = from[j * step->stride_x];
                    for (int64_t j = count; j < view->width; j++) to[j] = 0;
                }
}

static void convolve(const share_t *share, const image_step_t *step, const view_t *view) {
    const map_t *out = share->maps + step->out;
    plane_t x = map_of(share, step->in), y = begin(share, step->out), add = y, copy = y;
    if (step->add >= 0) add = map_of(share, step->add);
    if (step->copy >= 0) copy = begin(share, step->copy);
    block_t row = {.in = x.at - step->padding_y * x.row - step->padding_x,
                   .in_step = LANES,
                   .out = share->result,
                   .out_step = LANES,
                   .out_channel = view->result,
                   .relu = step->activation == RELU};
    if (strides(step)) {
        deal_out(share, step, view);
        row.in = share->dealt;
    }
    run_row(view->result / LANES, out->channels, view->taps, step->bias, &row);
    if (step->activation > RELU)
        activate(step->activation, (float)step->a, (float)step->b, share->result,
                 out->channels * view->result);
    for (int64_t c = 0; c < out->channels; c++)
        for (int64_t i = 0; i < out->height; i++) {
            const float *from = share->result + c * view->result + i * view->width;
            float *to = y.at + c * y.channel + i * y.row;
            const float *more = add.at + c * add.channel + i * add.row;
            float *also = copy.at + c * copy.channel + i * copy.row;
            for (int64_t j = 0; j < out->width; j++) to[j] = from[j];
            for (int64_t j = 0; j < out->width && step->add >= 0; j++) to[j] += more[j];
            for (int64_t j = 0; j < out->width && step->copy >= 0; j++) also[j] = to[j] <= 0 ? 0 : to[j];
        }
}

/* The larger of two rows of numbers; a NaN counts as largest. */
static void keep_larger(float *restrict best, const float *restrict v, int64_t step, int64_t count) {
    if (step == 1)
        for (int64_t j = 0; j < count; j++) best[j] = (v[j] > best[j]) | (v[j] != v[j]) ? v[j] : best[j];
    else
        for (int64_t j = 0; j < count; j++, v += step) best[j] = (*v > best[j]) | (*v != *v) ? *v : best[j];
}

static void pool(const share_t *share, const image_step_t *step) {
    const map_t *in = share->maps + step->in, *out = share->maps + step->out;
    plane_t x = map_of(share, step->in), y = begin(share, step->out), copy = y;
    if (step->copy >= 0) copy = begin(share, step->copy);
    float *column = share->result; /* the largest of each column */
    for (int64_t c = 0; c < out->channels; c++)
        for (int64_t i = 0; i < out->height; i++) {
            int64_t top = i * step->stride_y - step->padding_y;
            float *to = y.at + c * y.channel + i * y.row, *also = copy.at + c * copy.channel + i * copy.row;
            for (int64_t j = 0; j < in->width; j++) column[j] = -INFINITY;
            for (int64_t r = top < 0 ? -top : 0; r < step->kernel_y && top + r < in->height; r++)
                keep_larger(column, x.at + c * x.channel + (top + r) * x.row, 1, in->width);
            for (int64_t j = 0; j < out->width; j++) to[j] = -INFINITY;
            for (int64_t s = 0; s < step->kernel_x; s++) {
                int64_t shift = s - step->padding_x; /* j * stride_x + shift lies within the row */
                int64_t first = shift < 0 ? (-shift + step->stride_x - 1) / step->stride_x : 0;
                int64_t last = (in->width - 1 - shift) / step->stride_x;
                if (shift >= in->width) continue;
                if (last >= out->width) last = out->width - 1;
                keep_larger(to + first, column + first * step->stride_x + shift, step->stride_x, last - first + 1);
            }
            for (int64_t j = 0; j < out->width && step->copy >= 0; j++) also[j] = to[j] <= 0 ? 0 : to[j];
        }
}

static void work(void *argument) {
    share_t *share = argument;
    const images_t *images = share->images;
    const map_t *first = share->maps, *last = share->maps + share->steps[images->steps - 1].out;
    const float *from = images->images_in + share->first * first->channels * first->height * first->width;
    float *to = images->images_out + share->first * last->channels * last->height * last->width;
    for (int64_t n = share->first; n < share->last; n++) {
        plane_t x = begin(share, 0);
        for (int64_t row = 0; row < first->channels * first->height; row++, from += first->width)
            memcpy(x.at + row / first->height * x.channel + row % first->height * x.row, from,
                   first->width * sizeof *from);
        for (int64_t i = 0; i < images->steps; i++)
            if (share->steps[i].kind == CONVOLUTION)
                convolve(share, share->steps + i, share->views + i);
            else
                pool(share, share->steps + i);
        plane_t y = map_of(share, last - share->maps);
        for (int64_t row = 0; row < last->channels * last->height; row++, to += last->width)
            memcpy(to, y.at + row / last->height * y.channel + row % last->height * y.row,
                   last->width * sizeof *to);
    }
}

/* Offsets of a convolution's connections; returns the memory behind them. */
static int32_t *set_taps(const map_t *maps, const image_step_t *step, view_t *view, int32_t *memory) {
    int64_t nnz = step->row_start[maps[step->out].channels], tap = 0;
    int32_t *offset = memory, *of_tap = memory + nnz;
    for (int64_t c = 0; c < maps[step->in].channels; c++)
        for (int64_t r = 0; r < step->kernel_y; r++)
            for (int64_t s = 0; s < step->kernel_x; s++) {
                int64_t image = r % step->stride_y * step->stride_x + s % step->stride_x;
                int64_t at = r / step->stride_y * view->width + s / step->stride_x;
                of_tap[tap++] = (int32_t)(c * view->channel + image * view->height * view->width + at);
            }
    for (int64_t k = 0; k < nnz; k++) offset[k] = of_tap[step->column[k]];
    view->taps = (taps_t){step->row_start, offset, step->value};
    return of_tap;
}

int NAMED(images_one_by_one, SUFFIX)(const images_t *images, const map_t *maps, const image_step_t *steps) {
    share_t shares[MOST_SHARES];
    int64_t count = shares_of(images->batch, images->threads), n = images->steps;
    int64_t dealt = 0, result = 0, connections = 0, scratch = images->scratch_size / LANES;
    view_t *views = calloc(n, sizeof *views);
    if (!views) return -1;
    for (int64_t l = 0; l < n; l++) {
        const image_step_t *step = steps + l;
        int64_t channels = maps[step->in].channels, size = maps[step->in].width;
        if (step->kind == CONVOLUTION) {
            views[l] = view_of(images, maps, step);
            size = maps[step->out].channels * views[l].result;
            connections += step->row_start[maps[step->out].channels] + channels * step->kernel_y * step->kernel_x;
            if (strides(step) && channels * views[l].channel > dealt) dealt = channels * views[l].channel;
        }
        if (size > result) result = size;
    }
    /* A block of places runs on behind the end of what it reads by up to LANES - 1 numbers. */
    int64_t each = (scratch + LANES + dealt + LANES + result + LANES) / LANES * LANES;
    float *memory = sb3_sparse_scratch(((count * each + connections) * sizeof(float) + 63) / 64 * 64);
    if (!memory) {
        free(views);
        return -1;
    }
    int32_t *offsets = (int32_t *)(memory + count * each);
    for (int64_t l = 0; l < n; l++)
        if (steps[l].kind == CONVOLUTION) offsets = set_taps(maps, steps + l, views + l, offsets);
    for (int64_t i = 0; i < count; i++, memory += each)
        shares[i] = (share_t){.images = images, .maps = maps, .steps = steps, .views = views,
                              .first = images->batch * i / count,
                              .last = images->batch * (i + 1) / count,
                              .scratch = memory,
                              .dealt = memory + scratch + LANES,
                              .result = memory + scratch + LANES + dealt + LANES};
    run_shares(work, shares, sizeof *shares, count);
    free(views);
    return 0;
}
