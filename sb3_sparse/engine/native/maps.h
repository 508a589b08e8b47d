/* Maps in memory: channels of rows, each channel in a ring of zeros. */
#ifndef SB3_SPARSE_MAPS_H
#define SB3_SPARSE_MAPS_H

#include "images.h"
#include "vectors.h"

/* Keeps a compiler from spending a register on the address of each place. */
#if defined(__GNUC__)
#define ADDRESS(p) __asm__("" : "+r"(p))
#else
#define ADDRESS(p) (void)(p)
#endif

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

/* Zeros in place; a call of memset would cost more than a few of them. */
INLINE void clear(float *at, int64_t count) {
    for (; count >= WIDTH; count -= WIDTH, at += WIDTH) {
        STORE(at, (vec){0});
        ADDRESS(at); /* else compilers make it a call of memset */
    }
    for (; count > 0; count--) *at++ = 0;
}

static inline void clear_ring(const map_t *map, float *base, int64_t ring, int64_t lanes) {
    int64_t row = (map->width + 2 * ring) * lanes, side = ring * lanes, within = map->width * lanes;
    for (int64_t c = 0; c < map->channels && ring; c++) {
        clear(base, ring * row + side);
        base += ring * row + side;
        for (int64_t y = 1; y < map->height; y++) {
            base += within;
            clear(base, 2 * side);
            base += 2 * side;
        }
        base += within;
        clear(base, ring * row + side);
        base += ring * row + side;
    }
}

#if WIDTH == 16
/* Sixteen vectors, as rows of a matrix, become its columns. */
INLINE void transpose_square(__m512 *a) {
    __m512 b[16];
    for (int i = 0; i < 16; i += 2) {
        b[i] = _mm512_unpacklo_ps(a[i], a[i + 1]);
        b[i + 1] = _mm512_unpackhi_ps(a[i], a[i + 1]);
    }
    for (int i = 0; i < 16; i += 4)
        for (int j = 0; j < 2; j++) {
            __m512d low = _mm512_castps_pd(b[i + j]), high = _mm512_castps_pd(b[i + j + 2]);
            a[i + 2 * j] = _mm512_castpd_ps(_mm512_unpacklo_pd(low, high));
            a[i + 2 * j + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(low, high));
        }
    for (int i = 0; i < 16; i += 8)
        for (int j = 0; j < 4; j++) {
            b[i + j] = _mm512_shuffle_f32x4(a[i + j], a[i + j + 4], 0x88);
            b[i + j + 4] = _mm512_shuffle_f32x4(a[i + j], a[i + j + 4], 0xdd);
        }
    for (int j = 0; j < 8; j++) {
        a[j] = _mm512_shuffle_f32x4(b[j], b[j + 8], 0x88);
        a[j + 8] = _mm512_shuffle_f32x4(b[j], b[j + 8], 0xdd);
    }
}
#endif

/* A row of `entries` images, `stride` apart, to the lanes of a map's row; lanes without an image are 0. */
INLINE void take_row(const float *images, int64_t stride, int64_t entries, int64_t width, float *row) {
#if WIDTH == 16
    for (int64_t x = 0; x < width; x += 16) {
        int count = width - x < 16 ? (int)(width - x) : 16;
        __m512 a[16];
        for (int i = 0; i < 16; i++)
            a[i] = i < entries ? _mm512_maskz_loadu_ps((__mmask16)((1u << count) - 1), images + i * stride + x)
                               : _mm512_setzero_ps();
        transpose_square(a);
        for (int i = 0; i < count; i++) _mm512_storeu_ps(row + (x + i) * LANES, a[i]);
    }
#else
    transpose_all(images, entries, width, stride, row, LANES);
    for (int64_t x = 0; x < width && entries < LANES; x++)
        memset(row + x * LANES + entries, 0, (LANES - entries) * sizeof *row);
#endif
}

/* The same back. */
INLINE void give_row(const float *row, int64_t width, float *images, int64_t stride, int64_t entries) {
#if WIDTH == 16
    for (int64_t x = 0; x < width; x += 16) {
        int count = width - x < 16 ? (int)(width - x) : 16;
        __m512 a[16];
        for (int i = 0; i < 16; i++)
            a[i] = i < count ? _mm512_loadu_ps(row + (x + i) * LANES) : _mm512_setzero_ps();
        transpose_square(a);
        for (int i = 0; i < entries; i++)
            _mm512_mask_storeu_ps(images + i * stride + x, (__mmask16)((1u << count) - 1), a[i]);
    }
#else
    transpose_all(row, width, entries, LANES, images, stride);
#endif
}

/* Images [batch, channels, height, width] to and from a tile's map. */
static inline void take_images(const map_t *map, plane_t to, const float *images, int64_t entries) {
    int64_t size = map->height * map->width;
    for (int64_t c = 0; c < map->channels; c++)
        for (int64_t y = 0; y < map->height; y++)
            take_row(images + c * size + y * map->width, map->channels * size, entries, map->width,
                     to.at + c * to.channel + y * to.row);
}

static inline void give_images(const map_t *map, plane_t from, float *images, int64_t entries) {
    int64_t size = map->height * map->width;
    for (int64_t c = 0; c < map->channels; c++)
        for (int64_t y = 0; y < map->height; y++)
            give_row(from.at + c * from.channel + y * from.row, map->width,
                     images + c * size + y * map->width, map->channels * size, entries);
}

#endif
