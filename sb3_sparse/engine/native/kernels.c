#include "activations.h"
#include "products.h"
#include "threads.h"

#include <stdlib.h>

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

/* The functions behind ReLU on a tile; ReLU itself is a part of the products. */
static void activate_tile(const layer_t *layer, int64_t vectors, float *y) {
    int64_t whole = vectors * WIDTH == TILE, rows = whole ? 1 : layer->rows;
    int64_t count = whole ? layer->rows * TILE : vectors * WIDTH;
    for (int64_t r = 0; r < rows; r++)
        activate(layer->activation, (float)layer->a, (float)layer->b, y + r * TILE, count);
}
static void slope_tile(const layer_t *layer, int64_t vectors, const float *y, float *g) {
    int64_t whole = vectors * WIDTH == TILE, rows = whole ? 1 : layer->rows;
    int64_t count = whole ? layer->rows * TILE : vectors * WIDTH;
    for (int64_t r = 0; r < rows; r++)
        slope(layer->activation, (float)layer->a, (float)layer->b, y + r * TILE, g + r * TILE, count);
}

static void forward_share(void *argument) {
    share_t *share = argument;
    const batch_t *batch = share->batch;
    const layer_t *layers = share->layers, *last = layers + batch->layers - 1;
    for (int64_t t = share->first; t < share->last; t++) {
        int64_t entries = entries_of(batch, t), vectors = vectors_of(batch, t);
        float *x = batch->input + t * layers->columns * TILE;
        if (batch->rows_in)
            to_tile(batch->rows_in + t * TILE * layers->columns, entries, layers->columns, TILE, x);
        for (const layer_t *layer = layers; layer <= last; layer++) {
            float *y = layer->output + t * layer->rows * TILE;
            gather(vectors, layer->rows, layer->row_start, layer->column, layer->value,
                   layer->bias, 0, layer->activation == RELU, x, y);
            if (layer->activation > RELU) activate_tile(layer, vectors, y);
            x = y;
        }
        if (batch->rows_out)
            from_tile(x, entries, last->rows, TILE, batch->rows_out + t * TILE * last->rows);
    }
}

static void backward_share(void *argument) {
    share_t *share = argument;
    const batch_t *batch = share->batch;
    const layer_t *layers = share->layers, *top = layers + batch->layers - 1;
    int64_t first = share->first, last = share->last;
    const float *g = share->scratch[0];
    int64_t size = top->rows * TILE;
    if (!batch->rows_grad && !top->activation) g = batch->tiles_grad + first * size;
    for (int64_t t = first; t < last && g == share->scratch[0]; t++) {
        float *to = share->scratch[0] + (t - first) * size;
        if (batch->rows_grad)
            to_tile(batch->rows_grad + t * TILE * top->rows, entries_of(batch, t), top->rows, TILE,
                    to);
        else
            memcpy(to, batch->tiles_grad + t * size, (size_t)size * sizeof *to);
        if (top->activation) slope_tile(top, vectors_of(batch, t), top->output + t * size, to);
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
        int64_t before = l ? layers[l - 1].activation : IDENTITY;
        for (int64_t t = first; t < last; t++) {
            float *to = next + (t - first) * into;
            gather(vectors_of(batch, t), layer->columns, layer->column_start, layer->row,
                   share->values[l], 0, before == RELU ? x + t * into : 0, 0,
                   g + (t - first) * out, to);
            if (before > RELU) slope_tile(layer - 1, vectors_of(batch, t), x + t * into, to);
        }
        g = next;
    }
    for (int64_t t = first; t < last && batch->rows_input_grad; t++)
        from_tile(g + (t - first) * layers->columns * TILE, entries_of(batch, t), layers->columns,
                  TILE, batch->rows_input_grad + t * TILE * layers->columns);
}

static int64_t split(const layer_t *layers, const batch_t *batch, share_t *shares) {
    int64_t tiles = (batch->batch + TILE - 1) / TILE, count = shares_of(tiles, batch->threads);
    for (int64_t i = 0; i < count; i++)
        shares[i] = (share_t){.layers = layers, .batch = batch, .first = tiles * i / count,
                              .last = tiles * (i + 1) / count};
    return count;
}

void NAMED(forward, SUFFIX)(const layer_t *layers, const batch_t *batch) {
    share_t shares[MOST_SHARES];
    run_shares(forward_share, shares, sizeof *shares, split(layers, batch, shares));
}

int NAMED(backward, SUFFIX)(const layer_t *layers, const batch_t *batch) {
    share_t shares[MOST_SHARES];
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
    float *memory = sb3_sparse_scratch((size + 63) / 64 * 64);
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
    run_shares(backward_share, shares, sizeof *shares, count);
    for (int64_t i = 1; i < count; i++)
        for (int64_t l = 0; l < n; l++) {
            const layer_t *layer = layers + l;
            int64_t nnz = layer->row_start[layer->rows];
            if (layer->value_grad) add_to(layer->value_grad, shares[i].value_grads[l], nnz);
            if (layer->bias_grad) add_to(layer->bias_grad, shares[i].bias_grads[l], layer->rows);
        }
    free(lists);
    return 0;
}
