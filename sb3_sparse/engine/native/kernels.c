#include "kernels.h"

#include <pthread.h>
#include <stdlib.h>
#include <string.h>

#if defined(__AVX512F__)
#include <immintrin.h>
#define WIDTH 16
#elif defined(__AVX2__)
#include <immintrin.h>
#define WIDTH 8
#else
#define WIDTH 4
#endif

#ifndef __has_builtin
#define __has_builtin(x) 0
#endif
#if __has_builtin(__builtin_shufflevector)
#define SHUFFLE(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define SHUFFLE(a, b, i, j, k, l) __builtin_shuffle(a, b, (int32_t __attribute__((vector_size(16)))){i, j, k, l})
#endif

typedef float vec __attribute__((vector_size(WIDTH * 4)));
typedef float loose __attribute__((vector_size(WIDTH * 4), aligned(4), may_alias));
#define INLINE static inline __attribute__((always_inline))
#define LOAD(p) ((vec) * (const loose *)(p))
#define STORE(p, v) (*(loose *)(p) = (v))

/* Comparisons are turned so that a NaN stays one. */
INLINE vec positive(vec a) { return (vec)(~(a < 0) & (typeof(a < 0))a); }
INLINE vec where_positive(vec a, vec y) { return (vec)(~(y <= 0) & (typeof(a < 0))a); }

/* Sum of a vector's elements. */
INLINE float total(vec a) {
#if WIDTH == 16
    return _mm512_reduce_add_ps((__m512)a);
#else
    float sum = 0;
    for (int i = 0; i < WIDTH; i++) sum += a[i];
    return sum;
#endif
}

/* Sums of eight vectors, in out[0..7]: transposed by halves and added up. */
INLINE void totals(const vec *a, float *out, int add) {
#if WIDTH >= 8
#if WIDTH == 16
    __m512 p[4], q[2];
    for (int i = 0; i < 4; i++) {
        __m512 u = (__m512)a[2 * i], v = (__m512)a[2 * i + 1];
        p[i] = _mm512_add_ps(_mm512_unpacklo_ps(u, v), _mm512_unpackhi_ps(u, v));
    }
    for (int i = 0; i < 2; i++) {
        __m512d u = _mm512_castps_pd(p[2 * i]), v = _mm512_castps_pd(p[2 * i + 1]);
        q[i] = _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(u, v)),
                             _mm512_castpd_ps(_mm512_unpackhi_pd(u, v)));
    }
    __m512 lanes = _mm512_add_ps(_mm512_shuffle_f32x4(q[0], q[1], 0x88),
                                 _mm512_shuffle_f32x4(q[0], q[1], 0xdd));
    lanes = _mm512_add_ps(lanes, _mm512_shuffle_f32x4(lanes, lanes, 0xb1));
    __m256 sums = _mm512_castps512_ps256(_mm512_shuffle_f32x4(lanes, lanes, 0x08));
#else
    __m256 p = _mm256_hadd_ps(_mm256_hadd_ps((__m256)a[0], (__m256)a[1]),
                              _mm256_hadd_ps((__m256)a[2], (__m256)a[3]));
    __m256 q = _mm256_hadd_ps(_mm256_hadd_ps((__m256)a[4], (__m256)a[5]),
                              _mm256_hadd_ps((__m256)a[6], (__m256)a[7]));
    __m256 sums = _mm256_add_ps(_mm256_permute2f128_ps(p, q, 0x20),
                                _mm256_permute2f128_ps(p, q, 0x31));
#endif
    if (add) sums = _mm256_add_ps(sums, _mm256_loadu_ps(out));
    _mm256_storeu_ps(out, sums);
#else
    for (int i = 0; i < 8; i++) out[i] = (add ? out[i] : 0) + total(a[i]);
#endif
}

/* y[row] = start[row] + sum of value * x[column], N vectors wide, U connections at once. */
INLINE void gather_rows(int N, int U, int64_t rows, const int32_t *start, const int32_t *column,
                        const float *value, const float *bias, const float *gate, int relu,
                        const float *x, float *y) {
    for (int64_t r = 0; r < rows; r++) {
        vec sum[8];
        for (int i = 0; i < N * U; i++) sum[i] = (vec){0};
        if (bias)
            for (int j = 0; j < N; j++) sum[j] = bias[r] + (vec){0};
        int32_t k = start[r], end = start[r + 1];
        for (; k + U <= end; k += U)
            for (int u = 0; u < U; u++) {
                const float *from = x + (int64_t)column[k + u] * TILE;
                vec w = value[k + u] + (vec){0};
                for (int j = 0; j < N; j++) sum[u * N + j] += w * LOAD(from + j * WIDTH);
            }
        for (; k < end; k++) {
            const float *from = x + (int64_t)column[k] * TILE;
            vec w = value[k] + (vec){0};
            for (int j = 0; j < N; j++) sum[j] += w * LOAD(from + j * WIDTH);
        }
        for (int i = N; i < N * U; i++) sum[i % N] += sum[i];
        for (int j = 0; j < N; j++) {
            vec s = sum[j];
            if (relu) s = positive(s);
            if (gate) s = where_positive(s, LOAD(gate + r * TILE + j * WIDTH));
            STORE(y + r * TILE + j * WIDTH, s);
        }
    }
}

/* The same for `vectors` vectors of a tile. */
static void gather(int64_t vectors, int64_t rows, const int32_t *start, const int32_t *column,
                   const float *value, const float *bias, const float *gate, int relu,
                   const float *x, float *y) {
    for (int64_t j = 0; j < vectors;) {
        int64_t left = vectors - j, at = j * WIDTH;
        const float *g = gate ? gate + at : 0;
#define STEP(N, U)                                                                        \
    {                                                                                     \
        gather_rows(N, U, rows, start, column, value, bias, g, relu, x + at, y + at);     \
        j += N;                                                                           \
    }
        if (left >= 8)
            STEP(8, 1)
        else if (left >= 4)
            STEP(4, 2)
        else if (left >= 2)
            STEP(2, 4)
        else
            STEP(1, 8)
#undef STEP
    }
}

/* grad[k] (+)= <g[row of k], x[column of k]>, `vectors` vectors wide, eight connections at once. */
INLINE void dots_of(int64_t vectors, int64_t rows, const int32_t *start, const int32_t *column,
                    const float *g, const float *x, float *grad, int add) {
    for (int64_t r = 0; r < rows; r++) {
        const float *from = g + r * TILE;
        int32_t k = start[r], end = start[r + 1];
        for (; k + 8 <= end; k += 8) {
            const float *to[8];
            vec sum[8];
            for (int q = 0; q < 8; q++) {
                to[q] = x + (int64_t)column[k + q] * TILE;
                sum[q] = (vec){0};
            }
            for (int64_t j = 0; j < vectors; j++) {
                vec d = LOAD(from + j * WIDTH);
                for (int q = 0; q < 8; q++) sum[q] += d * LOAD(to[q] + j * WIDTH);
            }
            totals(sum, grad + k, add);
        }
        for (; k < end; k++) {
            const float *to = x + (int64_t)column[k] * TILE;
            vec sum = {0};
            for (int64_t j = 0; j < vectors; j++)
                sum += LOAD(from + j * WIDTH) * LOAD(to + j * WIDTH);
            grad[k] = (add ? grad[k] : 0) + total(sum);
        }
    }
}

static void dots(int64_t vectors, int64_t rows, const int32_t *start, const int32_t *column,
                 const float *g, const float *x, float *grad, int add) {
    if (vectors == TILE / WIDTH)
        dots_of(TILE / WIDTH, rows, start, column, g, x, grad, add);
    else
        dots_of(vectors, rows, start, column, g, x, grad, add);
}

static void sums(int64_t vectors, int64_t rows, const float *g, float *grad, int add) {
    for (int64_t r = 0; r < rows; r++) {
        vec sum = {0};
        for (int64_t j = 0; j < vectors; j++) sum += LOAD(g + r * TILE + j * WIDTH);
        grad[r] = (add ? grad[r] : 0) + total(sum);
    }
}

typedef float quad __attribute__((vector_size(16)));
typedef float loose_quad __attribute__((vector_size(16), aligned(4), may_alias));

/* A 4x4 block of `from` (rows `stride` apart) transposed into `to` (rows `step` apart). */
INLINE void transpose(const float *from, int64_t stride, float *to, int64_t step) {
    quad a = *(const loose_quad *)from, b = *(const loose_quad *)(from + stride);
    quad c = *(const loose_quad *)(from + 2 * stride), d = *(const loose_quad *)(from + 3 * stride);
    quad ab = SHUFFLE(a, b, 0, 4, 1, 5), cd = SHUFFLE(c, d, 0, 4, 1, 5);
    *(loose_quad *)to = SHUFFLE(ab, cd, 0, 1, 4, 5);
    *(loose_quad *)(to + step) = SHUFFLE(ab, cd, 2, 3, 6, 7);
    ab = SHUFFLE(a, b, 2, 6, 3, 7), cd = SHUFFLE(c, d, 2, 6, 3, 7);
    *(loose_quad *)(to + 2 * step) = SHUFFLE(ab, cd, 0, 1, 4, 5);
    *(loose_quad *)(to + 3 * step) = SHUFFLE(ab, cd, 2, 3, 6, 7);
}

/* to[f, b] = from[b, f] for b < rows and f < columns. */
static void transpose_all(const float *from, int64_t rows, int64_t columns, int64_t stride,
                          float *to, int64_t step) {
    int64_t whole_rows = rows / 4 * 4, whole_columns = columns / 4 * 4;
    for (int64_t b = 0; b < whole_rows; b += 4)
        for (int64_t f = 0; f < whole_columns; f += 4)
            transpose(from + b * stride + f, stride, to + f * step + b, step);
    for (int64_t f = 0; f < columns; f++)
        for (int64_t b = f < whole_columns ? whole_rows : 0; b < rows; b++)
            to[f * step + b] = from[b * stride + f];
}

/* [entries, features] to a tile; what fills it up to a whole vector is 0. */
static void to_tile(const float *rows, int64_t entries, int64_t features, float *tile) {
    transpose_all(rows, entries, features, features, tile, TILE);
    int64_t padded = (entries + WIDTH - 1) / WIDTH * WIDTH;
    for (int64_t f = 0; f < features && padded > entries; f++)
        memset(tile + f * TILE + entries, 0, (padded - entries) * sizeof *tile);
}

static void from_tile(const float *tile, int64_t entries, int64_t features, float *rows) {
    transpose_all(tile, features, entries, TILE, rows, features);
}

/* One thread's share of a batch: the tiles [first, last). */
typedef struct {
    const layer_t *layers;
    const batch_t *batch;
    int64_t first, last;
    float **value_grads, **bias_grads; /* where this thread adds up, by layer */
    float **values;                    /* by columns, by layer */
    float *scratch[2];                 /* gradients of its tiles */
} share_t;

static int64_t entries_of(const batch_t *batch, int64_t tile) {
    int64_t left = batch->batch - tile * TILE;
    return left < TILE ? left : TILE;
}

static int64_t vectors_of(const batch_t *batch, int64_t tile) {
    return (entries_of(batch, tile) + WIDTH - 1) / WIDTH;
}

static void forward_share(share_t *share) {
    const batch_t *batch = share->batch;
    const layer_t *layers = share->layers, *last = layers + batch->layers - 1;
    for (int64_t t = share->first; t < share->last; t++) {
        int64_t entries = entries_of(batch, t), vectors = vectors_of(batch, t);
        float *x = batch->input + t * layers->columns * TILE;
        if (batch->rows_in)
            to_tile(batch->rows_in + t * TILE * layers->columns, entries, layers->columns, x);
        for (const layer_t *layer = layers; layer <= last; layer++) {
            float *y = layer->output + t * layer->rows * TILE;
            gather(vectors, layer->rows, layer->row_start, layer->column, layer->value,
                   layer->bias, 0, (int)layer->relu, x, y);
            x = y;
        }
        if (batch->rows_out)
            from_tile(x, entries, last->rows, batch->rows_out + t * TILE * last->rows);
    }
}

static void backward_share(share_t *share) {
    const batch_t *batch = share->batch;
    const layer_t *layers = share->layers, *top = layers + batch->layers - 1;
    int64_t first = share->first, last = share->last;
    const float *g = share->scratch[0];
    int64_t size = top->rows * TILE;
    if (!batch->rows_grad && !top->relu) g = batch->tiles_grad + first * size;
    for (int64_t t = first; t < last && g == share->scratch[0]; t++) {
        float *to = share->scratch[0] + (t - first) * size;
        const float *from = to, *y = top->output + t * size;
        if (batch->rows_grad)
            to_tile(batch->rows_grad + t * TILE * top->rows, entries_of(batch, t), top->rows, to);
        else
            from = batch->tiles_grad + t * size;
        for (int64_t r = 0; r < size && top->relu; r += TILE)
            for (int64_t b = r; b < r + vectors_of(batch, t) * WIDTH; b += WIDTH)
                STORE(to + b, where_positive(LOAD(from + b), LOAD(y + b)));
    }
    for (int64_t l = batch->layers - 1; l >= 0; l--) {
        const layer_t *layer = layers + l;
        int64_t into = layer->columns * TILE, out = layer->rows * TILE;
        const float *x = l ? layers[l - 1].output : batch->input;
        for (int64_t t = first; t < last; t++) {
            const float *from = g + (t - first) * out;
            int64_t vectors = vectors_of(batch, t);
            if (share->value_grads[l])
                dots(vectors, layer->rows, layer->row_start, layer->column, from, x + t * into,
                     share->value_grads[l], t > first);
            if (share->bias_grads[l])
                sums(vectors, layer->rows, from, share->bias_grads[l], t > first);
            if (layer->output_grad)
                memcpy(layer->output_grad + t * out, from, out * sizeof *from);
        }
        if (l == 0 && !batch->rows_input_grad && !batch->tiles_input_grad) return;
        float *next = g == share->scratch[0] ? share->scratch[1] : share->scratch[0];
        if (l == 0 && batch->tiles_input_grad) next = batch->tiles_input_grad + first * into;
        for (int64_t t = first; t < last; t++)
            gather(vectors_of(batch, t), layer->columns, layer->column_start, layer->row,
                   share->values[l], 0, l && layers[l - 1].relu ? x + t * into : 0, 0,
                   g + (t - first) * out, next + (t - first) * into);
        g = next;
    }
    for (int64_t t = first; t < last && batch->rows_input_grad; t++)
        from_tile(g + (t - first) * layers->columns * TILE, entries_of(batch, t), layers->columns,
                  batch->rows_input_grad + t * TILE * layers->columns);
}

typedef struct {
    void (*work)(share_t *);
    share_t *shares;
    int64_t count;
} job_t;

static void take_shares(void *argument) {
    const job_t *job = argument;
    for (int64_t i = sb3_sparse_openmp.thread(); i < job->count; i += sb3_sparse_openmp.threads())
        job->work(job->shares + i);
}

static void run(void (*work)(share_t *), share_t *shares, int64_t count) {
    job_t job = {work, shares, count};
    if (count > 1 && sb3_sparse_openmp.parallel)
        sb3_sparse_openmp.parallel(take_shares, &job, (unsigned)count, 0);
    else
        for (int64_t i = 0; i < count; i++) work(shares + i);
}

static int64_t split(const layer_t *layers, const batch_t *batch, share_t *shares) {
    int64_t tiles = (batch->batch + TILE - 1) / TILE, count = batch->threads;
    if (count > tiles) count = tiles;
    if (count > 64) count = 64;
    if (count < 1) count = 1;
    for (int64_t i = 0; i < count; i++)
        shares[i] = (share_t){.layers = layers, .batch = batch, .first = tiles * i / count,
                              .last = tiles * (i + 1) / count};
    return count;
}

void NAMED(forward, SUFFIX)(const layer_t *layers, const batch_t *batch) {
    share_t shares[64];
    run(forward_share, shares, split(layers, batch, shares));
}

static pthread_key_t at_exit;
static pthread_once_t once = PTHREAD_ONCE_INIT;
static void make_key(void) { pthread_key_create(&at_exit, free); }

/* Memory of this thread that stays for the next call: new pages cost as much as the products.
   The address sanitizer gets exact sizes instead. */
static float *scratch_of(size_t size) {
    static _Thread_local float *kept;
    static _Thread_local size_t kept_size;
#ifdef __SANITIZE_ADDRESS__
    kept_size = 0;
#endif
    if (size > kept_size) {
        free(kept);
        kept = aligned_alloc(64, size);
        kept_size = kept ? size : 0;
        pthread_once(&once, make_key);
        pthread_setspecific(at_exit, kept); /* freed with the thread */
    }
    return kept;
}

int NAMED(backward, SUFFIX)(const layer_t *layers, const batch_t *batch) {
    share_t shares[64];
    int64_t count = split(layers, batch, shares), n = batch->layers;
    int64_t tiles = (batch->batch + TILE - 1) / TILE, widest = 0, values = 0, grads = 0;
    for (int64_t l = 0; l < n; l++) {
        const layer_t *layer = layers + l;
        int64_t nnz = layer->row_start[layer->rows];
        if (layer->rows > widest) widest = layer->rows;
        if (layer->columns > widest) widest = layer->columns;
        values += nnz;
        grads += nnz + layer->rows;
    }
    /* Scratch first: whole tiles, so that each vector lies within a cache line. */
    size_t size = sizeof(float) * (tiles * 2 * widest * TILE + values + (count - 1) * grads);
    float *memory = scratch_of((size + 63) / 64 * 64);
    float **lists = malloc(sizeof *lists * n * (1 + 2 * count));
    if (!memory || !lists) {
        free(lists);
        return -1;
    }
    float *scratch = memory, *next = memory + tiles * 2 * widest * TILE, **list = lists + n;
    for (int64_t l = 0; l < n; l++) {
        const layer_t *layer = layers + l;
        int64_t nnz = layer->row_start[layer->rows];
        lists[l] = next;
        next += nnz;
        if (l || batch->rows_input_grad || batch->tiles_input_grad)
            for (int64_t k = 0; k < nnz; k++) lists[l][k] = layer->value[layer->position[k]];
    }
    for (int64_t i = 0; i < count; i++) {
        shares[i].values = lists;
        for (int s = 0; s < 2; s++) {
            shares[i].scratch[s] = scratch;
            scratch += (shares[i].last - shares[i].first) * widest * TILE;
        }
        shares[i].value_grads = list;
        shares[i].bias_grads = list + n;
        list += 2 * n;
        for (int64_t l = 0; l < n; l++) {
            const layer_t *layer = layers + l;
            shares[i].value_grads[l] = i && layer->value_grad ? next : layer->value_grad;
            next += i ? layer->row_start[layer->rows] : 0;
            shares[i].bias_grads[l] = i && layer->bias_grad ? next : layer->bias_grad;
            next += i ? layer->rows : 0;
        }
    }
    run(backward_share, shares, count);
    for (int64_t i = 1; i < count; i++)
        for (int64_t l = 0; l < n; l++) {
            const layer_t *layer = layers + l;
            int64_t nnz = layer->row_start[layer->rows];
            if (layer->value_grad)
                for (int64_t k = 0; k < nnz; k++) layer->value_grad[k] += shares[i].value_grads[l][k];
            if (layer->bias_grad)
                for (int64_t r = 0; r < layer->rows; r++)
                    layer->bias_grad[r] += shares[i].bias_grads[l][r];
        }
    free(lists);
    return 0;
}

/* WIDTH elements of x. */
INLINE vec pick(const float *x, const int32_t *column) {
#if WIDTH == 16
    return (vec)_mm512_i32gather_ps(_mm512_loadu_si512(column), x, 4);
#elif WIDTH == 8
    return (vec)_mm256_i32gather_ps(x, _mm256_loadu_si256((const __m256i *)column), 4);
#else
    return (vec){x[column[0]], x[column[1]], x[column[2]], x[column[3]]};
#endif
}

/* y = relu(W x + b) for one input. */
void NAMED(single, SUFFIX)(const layer_t *layer, const float *x, float *y) {
    for (int64_t r = 0; r < layer->rows; r++) {
        vec even = {0}, odd = {0};
        int32_t k = layer->row_start[r], end = layer->row_start[r + 1];
        for (; k + 2 * WIDTH <= end; k += 2 * WIDTH) {
            even += LOAD(layer->value + k) * pick(x, layer->column + k);
            odd += LOAD(layer->value + k + WIDTH) * pick(x, layer->column + k + WIDTH);
        }
        if (k + WIDTH <= end) {
            even += LOAD(layer->value + k) * pick(x, layer->column + k);
            k += WIDTH;
        }
        float s = total(even + odd);
        for (; k < end; k++) s += layer->value[k] * x[layer->column[k]];
        if (layer->bias) s += layer->bias[r];
        y[r] = layer->relu && s < 0 ? 0 : s;
    }
}
