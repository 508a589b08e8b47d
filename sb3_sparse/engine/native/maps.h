/* Maps in memory: channels of rows, each channel in a ring of zeros. */
#ifndef SB3_SPARSE_MAPS_H
#define SB3_SPARSE_MAPS_H

#include "images.h"

#include <string.h>

/* Where the first number within the ring is, and the distances of rows and channels. */
typedef struct {
    float *at;
    int64_t row, channel;
} plane_t;

static inline int64_t size_of(const map_t *map, int64_t ring, int64_t lanes) {
    return map->channels * (map->height + 2 * ring) * (map->width + 2 * ring) * lanes;
}

static inline plane_t plane_of(const map_t *map, float *base, int64_t ring, int64_t lanes) {
    plane_t plane = {base, (map->width + 2 * ring) * lanes, 0};
    plane.channel = (map->height + 2 * ring) * plane.row;
    plane.at += ring * (plane.row + lanes);
    return plane;
}

static inline void clear_ring(const map_t *map, float *base, int64_t ring, int64_t lanes) {
    int64_t row = (map->width + 2 * ring) * lanes, side = ring * lanes, within = map->width * lanes;
    for (int64_t c = 0; c < map->channels && ring; c++) {
        memset(base, 0, (ring * row + side) * sizeof *base);
        base += ring * row + side;
        for (int64_t y = 1; y < map->height; y++) {
            base += within;
            memset(base, 0, 2 * side * sizeof *base);
            base += 2 * side;
        }
        base += within;
        memset(base, 0, (ring * row + side) * sizeof *base);
        base += ring * row + side;
    }
}

#endif
