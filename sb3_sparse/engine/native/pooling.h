/* Max pooling of a tile, forth and back. */
#ifndef SB3_SPARSE_POOLING_H
#define SB3_SPARSE_POOLING_H

#include "activations.h"
#include "maps.h"

/* The first largest number of each window, in torch's order; a NaN counts as largest. `taken`: which taps
   they are, or NULL. */
static void pool(const image_step_t *step, const map_t *in, const map_t *out, plane_t x, plane_t y,
                 plane_t copy, int8_t *taken) {
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

/* Adds the gradient of each result to that of the number it is. */
static void pool_back(const image_step_t *step, const map_t *in, const map_t *out, plane_t g, plane_t to,
                      const int8_t *taken) {
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

#endif
