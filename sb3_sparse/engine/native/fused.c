/* Runs programs of fused.h. */
#include "fused.h"

#include "activations.h"
#include "products.h"
#include "threads.h"

#include "dense.h"

#include <math.h>

INLINE vec root_of(vec x) {
#if WIDTH == 16
    return (vec)_mm512_sqrt_ps((__m512)x);
#elif WIDTH == 8
    return (vec)_mm256_sqrt_ps((__m256)x);
#else
    for (int i = 0; i < WIDTH; i++) x[i] = sqrtf(x[i]);
    return x;
#endif
}

/* As exp_of, but infinite where float is. */
INLINE vec whole_exp_of(vec x) {
    ivec large = x > 87;
    vec y = exp_of(choose(large, x - 1, x));
    y = choose(large, y * 2.71828183f, y);
    y = choose(x > 88.7228394f, INFINITY + (vec){0}, y);
    return choose(x < -103.97f, (vec){0}, y);
}

/* x = m 2^n with m around 1; ln m by the series of its inverse hyperbolic tangent. */
INLINE vec log_of(vec x) {
    ivec bits = (ivec)x;
    ivec n = (bits - 0x3f3504f3) >> 23; /* so that m lies from the root of 1/2 to that of 2 */
    vec m = (vec)(bits - (n << 23));
    vec s = (m - 1) / (m + 1), z = s * s;
    vec p = z * (2.f / 9) + 2.f / 7;
    p = p * z + 2.f / 5;
    p = p * z + 2.f / 3;
    vec f = m - 1; /* ln m = f - s (f - z p), which keeps what is small */
    vec y = f - s * (f - z * p);
    vec e = __builtin_convertvector(n, vec);
    y = (e * 1.42860677e-6f + y) + e * 0.693145752f;
    y = choose(x > 3.4028e38f, x, y);
    y = choose(x == 0, -INFINITY + (vec){0}, y);
    y = choose(x < 0, NAN + (vec){0}, y);
    return choose(x != x, x, y);
}

static float gelu_slope(float z, float a, float b) {
    (void)a, (void)b;
    return 0.5f * (1 + erff(z * 0.707106781f)) + z * 0.398942280f * expf(-0.5f * z * z);
}

/* The gradient g times the slope at the input z, of functions whose result does not tell it. */
INLINE vec sloped_at(int64_t kind, vec g, vec z) {
    switch (kind) {
    case SILU: {
        vec s = 1 / (1 + exp_of(-z));
        return g * (s * (1 + z * (1 - s)));
    }
    case GELU: return g * one_by_one(z, gelu_slope, 0, 0);
    case GELU_TANH: {
        vec t = tanh_of(0.797884561f * (z + 0.044715f * z * z * z));
        vec inner = 0.797884561f * (1 + 3 * 0.044715f * z * z);
        return g * (0.5f * (1 + t) + 0.5f * z * (1 - t * t) * inner);
    }
    default: return g;
    }
}

typedef struct {
    const program_t *program;
    int64_t thread, tile, first_tile, entries, vectors;
} where_t;

INLINE float *at(const place_t *place, const where_t *where) {
    return place->base + where->thread * place->thread + where->tile * place->tile;
}

/* Distance of an operand's vectors. What the whole batch shares has one vector. */
INLINE int64_t step_of(const place_t *place) { return place->thread | place->tile ? WIDTH : 0; }

/* Loops over features and vectors of the operands that a kind has. */
#define EACH(EXPRESSION)                                                              \
    for (int64_t f = 0; f < o->features; f++)                                         \
        for (int64_t j = 0; j < where->vectors; j++) {                                \
            vec x = LOAD(a + f * o->a.feature + j * a_step);                          \
            STORE(to + f * o->to.feature + j * WIDTH, EXPRESSION);                    \
        }                                                                             \
    break;
#define Y LOAD(b + f * o->b.feature + j * b_step)
#define Z LOAD(c + f * o->c.feature + j * c_step)
#define ONE_IF(CONDITION) ((vec)((CONDITION) & (ivec)(1 + (vec){0})))

INLINE vec least(vec x, vec y) { return choose((y < x) | (y != y), y, x); }
INLINE vec huber(vec x) {
    vec d = magnitude(x), h = at_most(d, 1);
    return h * (d - 0.5f * h);
}

static void activate_op(const operation_t *o, const where_t *where, const float *a, float *to) {
    float p = (float)o->p, q = (float)o->q;
    for (int64_t f = 0; f < o->features; f++) {
        float *row = to + f * o->to.feature;
        memmove(row, a + f * o->a.feature, where->vectors * WIDTH * sizeof *row);
        activate(o->number, p, q, row, where->vectors * WIDTH);
    }
}

static void slope_op(const operation_t *o, const where_t *where, const float *a, const float *b,
                     float *to) {
    float p = (float)o->p, q = (float)o->q;
    for (int64_t f = 0; f < o->features; f++) {
        float *row = to + f * o->to.feature;
        if (row != a + f * o->a.feature)
            memcpy(row, a + f * o->a.feature, where->vectors * WIDTH * sizeof *row);
        slope(o->number, p, q, b + f * o->b.feature, row, where->vectors * WIDTH);
    }
}

static void elementwise(const operation_t *o, const where_t *where) {
    const float *a = at(&o->a, where), *b = at(&o->b, where), *c = at(&o->c, where);
    int64_t a_step = step_of(&o->a), b_step = step_of(&o->b), c_step = step_of(&o->c);
    float *to = at(&o->to, where);
    switch (o->kind) {
    case COPY: EACH(x)
    case ADD: EACH(x + Y)
    case SUBTRACT: EACH(x - Y)
    case MULTIPLY: EACH(x * Y)
    case MULTIPLY_ADD: EACH(x * Y + Z)
    case DIVIDE: EACH(x / Y)
    case LEAST: EACH(least(x, Y))
    case LESS: EACH(ONE_IF(x < Y))
    case SAME: EACH(ONE_IF(x == Y))
    case CLAMP: EACH(choose(x < Y, Y, choose(x > Z, Z, x)))
    case INSIDE: EACH(ONE_IF((x >= Y) & (x <= Z)))
    case EXP: EACH(whole_exp_of(x))
    case LOG: EACH(log_of(x))
    case SQRT: EACH(root_of(x))
    case ABS: EACH(magnitude(x))
    case HUBER: EACH(huber(x))
    case ACTIVATION: activate_op(o, where, a, to); break;
    case SLOPE_RESULT: slope_op(o, where, a, b, to); break;
    case SLOPE_INPUT:
        switch (o->number) {
        case SILU: EACH(sloped_at(SILU, x, Y))
        case GELU: EACH(sloped_at(GELU, x, Y))
        case GELU_TANH: EACH(sloped_at(GELU_TANH, x, Y))
        }
        break;
    }
}

static void fill(const operation_t *o, const where_t *where) {
    const float *a = at(&o->a, where);
    float *to = at(&o->to, where);
    for (int64_t f = 0; f < o->features; f++, a += o->a.feature, to += TILE) {
        for (int64_t e = 0; e < where->vectors * WIDTH; e += WIDTH) STORE(to + e, *a + (vec){0});
        for (int64_t e = where->entries; e < where->vectors * WIDTH; e++) to[e] = 0;
    }
}

/* Puts the smaller of two features first, in each lane; a NaN is greater than all. */
INLINE void in_order(float *one, float *two, int64_t numbers) {
    for (int64_t j = 0; j < numbers; j += WIDTH) {
        vec x = LOAD(one + j), y = LOAD(two + j);
        ivec swap = (y < x) | ((x != x) & (y == y));
        STORE(one + j, choose(swap, y, x));
        STORE(two + j, choose(swap, x, y));
    }
}

/* Batcher's odd-even merge sort, for any number of features. */
static void sort_features(float *x, int64_t features, int64_t numbers) {
    for (int64_t p = 1; p < features; p *= 2)
        for (int64_t k = p; k >= 1; k /= 2)
            for (int64_t j = k % p; j + k < features; j += 2 * k)
                for (int64_t i = j; i < j + k && i + k < features; i++)
                    if (i / (2 * p) == (i + k) / (2 * p))
                        in_order(x + i * TILE, x + (i + k) * TILE, numbers);
}

/* For each estimate a of a quantile, the loss to all targets b and its derivative: the Huber loss
   of their distance, weighted by `share` if the target is at or above the estimate, else by
   1 - share. `first` is the number of estimates, `last` that of targets. */
static void quantile_huber(const operation_t *o, const where_t *where) {
    const float *a = at(&o->a, where), *b = at(&o->b, where);
    float *to = at(&o->to, where);
    for (int64_t q = 0; q < o->first; q++) {
        float share = (q + 0.5f) / o->first;
        for (int64_t j = 0; j < where->vectors; j++) {
            vec x = LOAD(a + q * o->a.feature + j * WIDTH), loss = {0}, slope = {0};
            for (int64_t t = 0; t < o->last; t++) {
                vec d = LOAD(b + t * o->b.feature + j * WIDTH) - x;
                vec weight = choose(d < 0, 1 - share + (vec){0}, share + (vec){0});
                loss += weight * huber(d);
                slope -= weight * (at_least(at_most(d, 1), -1) + 0 * d); /* NaN for infinity */
            }
            STORE(to + q * o->to.feature + j * WIDTH, loss);
            STORE(to + (o->first + q) * o->to.feature + j * WIDTH, slope);
        }
    }
}

/* Over features. The operand of PICK and the result of PUT have blocks of `first` features; all
   other operands have `first` features. */
static void over_features(const operation_t *o, const where_t *where) {
    const float *a = at(&o->a, where), *b = at(&o->b, where);
    float *to = at(&o->to, where);
    int64_t numbers = where->vectors * WIDTH;
    switch (o->kind) {
    case SUM_FEATURES: /* of all blocks, for each feature of the result */
        for (int64_t g = 0; g < o->features; g++)
            for (int64_t j = 0; j < numbers; j += WIDTH) {
                vec found = LOAD(a + g * o->a.feature + j);
                for (int64_t f = g + o->features; f < o->first; f += o->features)
                    found += LOAD(a + f * o->a.feature + j);
                STORE(to + g * o->to.feature + j, found);
            }
        break;
    case MAX_FEATURES:
    case ARGMAX: /* the number of the first one */
        for (int64_t j = 0; j < numbers; j += WIDTH) {
            vec found = LOAD(a + j), number = {0};
            for (int64_t f = 1; f < o->first; f++) {
                vec x = LOAD(a + f * o->a.feature + j);
                ivec more = (x > found) | ((x != x) & (found == found));
                found = choose(more, x, found);
                number = choose(more, (float)f + (vec){0}, number);
            }
            STORE(to + j, o->kind == ARGMAX ? number : found);
        }
        break;
    case PICK: /* of each block the feature whose number is b */
        for (int64_t g = 0; g < o->features; g++)
            for (int64_t e = 0; e < numbers; e++) {
                int64_t f = (int64_t)b[e];
                int is_one = f >= 0 && f < o->first;
                to[g * o->to.feature + e] = is_one ? a[(g * o->first + f) * o->a.feature + e] : NAN;
            }
        break;
    case PUT: /* the block's number in a at the feature whose number is b, else 0 */
        for (int64_t f = 0; f < o->features; f++) {
            const float *from = a + f / o->first * o->a.feature;
            for (int64_t e = 0; e < numbers; e++)
                to[f * o->to.feature + e] = (int64_t)b[e] == f % o->first ? from[e] : 0;
        }
        break;
    case SORT: /* in ascending order */
        for (int64_t f = 0; f < o->features; f++)
            memcpy(to + f * TILE, a + f * o->a.feature, numbers * sizeof *to);
        sort_features(to, o->features, numbers);
        break;
    case QUANTILE_HUBER: quantile_huber(o, where); break;
    }
}

#define ROWS(TYPE)                                                                          \
    for (int64_t e = 0; e < entries; e++) {                                                 \
        int64_t n = from + e;                                                               \
        const TYPE *row = (const TYPE *)input->rows + (input->index ? input->index[n] : n) * input->stride; \
        for (int64_t f = 0; f < o->features; f++) to[f * TILE + e] = (float)row[f];         \
    }                                                                                       \
    break;

/* What fills up the last vector repeats the last entry, so that it is as finite as the rest. */
static void load_rows(const operation_t *o, const where_t *where) {
    const input_t *input = where->program->inputs + o->number;
    int64_t from = where->tile * TILE, entries = where->entries;
    float *to = at(&o->to, where);
    switch (input->type) {
    case FLOAT32:
        if (!input->index && input->stride == o->features) {
            to_tile((const float *)input->rows + from * o->features, entries, o->features, TILE, to);
            break;
        }
        ROWS(float)
    case FLOAT64: ROWS(double)
    case INT64: ROWS(int64_t)
    case INT32: ROWS(int32_t)
    case UINT8: ROWS(uint8_t)
    case INT8: ROWS(int8_t)
    }
    for (int64_t f = 0; f < o->features; f++)
        for (int64_t e = entries; e < where->vectors * WIDTH; e++)
            to[f * TILE + e] = to[f * TILE + entries - 1];
}

static void linear(const operation_t *o, const where_t *where) {
    const linear_t *layer = where->program->layers + o->number;
    const float *x = at(&o->a, where);
    float *y = at(&o->to, where);
    int relu = o->first == RELU;
    if (layer->row_start)
        gather(where->vectors, layer->rows, layer->row_start, layer->column, layer->value,
               layer->bias, 0, relu, x, y);
    else
        dense_forward(where->vectors, layer->rows, layer->columns, layer->value, layer->bias, relu, x, y);
    if (o->first > RELU)
        for (int64_t f = 0; f < layer->rows; f++)
            activate(o->first, (float)o->p, (float)o->q, y + f * TILE, where->vectors * WIDTH);
}

/* The gradient of a layer's inputs first..last; 0 where b is not positive, if there is one. */
static void linear_back(const operation_t *o, const where_t *where) {
    const linear_t *layer = where->program->layers + o->number;
    const float *g = at(&o->a, where), *gate = o->b.base ? at(&o->b, where) : 0;
    float *to = at(&o->to, where);
    if (layer->row_start)
        gather(where->vectors, o->last - o->first, layer->column_start + o->first, layer->row,
               layer->turned, 0, gate, 0, g, to);
    else
        dense_back(where->vectors, layer->rows, layer->columns, o->first, o->last, layer->value, g,
                   gate, to);
}

/* Gradients of weight and bias from a, that of the layer's result, and b, its input. They are added
   to those that are there already if `first` is not 0. */
static void linear_grad(const operation_t *o, const where_t *where) {
    const linear_t *layer = where->program->layers + o->number;
    const float *g = at(&o->a, where), *x = at(&o->b, where);
    int64_t own = where->thread * where->program->per_thread;
    int again = (int)o->first, add = again || where->tile > where->first_tile;
    if (o->kind == LINEAR_DENSE_GRAD) {
        dense_dots(where->vectors, layer->rows, layer->columns, g, x, layer->dense_grad, again || where->tile > 0);
        return;
    }
    if (layer->row_start)
        dots(where->vectors, layer->rows, layer->row_start, layer->column, g, x,
             layer->weight_grad + own, add);
    else
        dense_dots(where->vectors, layer->rows, layer->columns, g, x, layer->weight_grad + own, add);
    if (layer->bias) sums(where->vectors, layer->rows, g, layer->bias_grad + own, add);
}

static void run_tiled(const operation_t *o, const where_t *where) {
    switch (o->kind) {
    case FILL: fill(o, where); break;
    case SUM_FEATURES: case MAX_FEATURES: case PICK: case PUT: case ARGMAX: case SORT:
    case QUANTILE_HUBER: over_features(o, where); break;
    case LOAD_ROWS: load_rows(o, where); break;
    case LINEAR: linear(o, where); break;
    case LINEAR_BACK: linear_back(o, where); break;
    case LINEAR_GRAD: case LINEAR_DENSE_GRAD: linear_grad(o, where); break;
    default: elementwise(o, where);
    }
}

/* One phase and how its tiles are shared. */
typedef struct {
    const program_t *program;
    const operation_t *first, *last;
    int64_t tiles, shares;
} phase_t;

typedef struct {
    const phase_t *phase;
    int64_t number;
} share_t;

static void run_share(void *argument) {
    const share_t *share = argument;
    const phase_t *phase = share->phase;
    where_t where = {.program = phase->program, .thread = share->number};
    where.first_tile = phase->tiles * share->number / phase->shares;
    int64_t end = phase->tiles * (share->number + 1) / phase->shares;
    for (where.tile = where.first_tile; where.tile < end; where.tile++) {
        int64_t left = phase->program->batch - where.tile * TILE;
        where.entries = left < TILE ? left : TILE;
        where.vectors = (where.entries + WIDTH - 1) / WIDTH;
        for (const operation_t *o = phase->first; o < phase->last; o++) run_tiled(o, &where);
    }
}

/* Adds what another thread has found, and leaves 0, to which a later operation may add. */
static void take_over(float *to, float *from, int64_t count) {
    add_to(to, from, count);
    memset(from, 0, (size_t)count * sizeof *from);
}

static void run_phase(const program_t *program, const operation_t *first, const operation_t *last) {
    int64_t tiles = (program->batch + TILE - 1) / TILE;
    phase_t phase = {program, first, last, tiles, 1};
    share_t shares[MOST_SHARES];
    int captures = 0; /* what several threads would add up in one place */
    for (const operation_t *o = first; o < last; o++) captures |= o->kind == LINEAR_DENSE_GRAD;
    if (sb3_sparse_openmp.parallel && !captures) phase.shares = shares_of(tiles, program->threads);
    for (int64_t i = 0; i < phase.shares; i++) shares[i] = (share_t){&phase, i};
    run_shares(run_share, shares, sizeof *shares, phase.shares);
    if (phase.shares == 1) return;
    for (const operation_t *o = first; o < last; o++) {
        if (o->kind != LINEAR_GRAD) continue;
        const linear_t *layer = program->layers + o->number;
        int64_t count = layer->row_start ? layer->row_start[layer->rows] : layer->rows * layer->columns;
        for (int64_t i = 1; i < phase.shares; i++) {
            int64_t own = i * program->per_thread;
            take_over(layer->weight_grad, layer->weight_grad + own, count);
            if (layer->bias) take_over(layer->bias_grad, layer->bias_grad + own, layer->rows);
        }
    }
}

static void set_lanes(float *to, float x) {
    STORE(to, x + (vec){0});
}

/* Each feature's sum over the batch. */
static void sum_batch(const program_t *program, const operation_t *o) {
    for (int64_t f = 0; f < o->features; f++) {
        double sum = 0;
        for (int64_t n = 0; n < program->batch; n += TILE) {
            const float *a = o->a.base + n / TILE * o->a.tile + f * o->a.feature;
            int64_t entries = program->batch - n < TILE ? program->batch - n : TILE;
            for (int64_t e = 0; e < entries; e++) sum += a[step_of(&o->a) ? e : 0];
        }
        set_lanes(o->to.base + f * TILE, (float)sum);
    }
}

/* A feature's sum over the batch of x - offset, or of x times y if there is one. */
static double sum_of(const program_t *program, const place_t *x, const place_t *y, int64_t f, float offset) {
    const float *a = x->base + f * x->feature, *b = y ? y->base + f * y->feature : 0;
    int64_t each = y && step_of(y); /* whether y differs from entry to entry */
    double sum = 0;
    vec part = {0}, more = {0};
    int64_t left = program->batch;
    for (int64_t tile = 0; left > 0; tile++, left -= TILE, a += x->tile, b += y ? y->tile : 0) {
        int64_t entries = left < TILE ? left : TILE, e = 0;
        for (; e + 2 * WIDTH <= entries; e += 2 * WIDTH) {
            part += b ? LOAD(a + e) * LOAD(b + each * e) : LOAD(a + e) - offset;
            int64_t next = e + WIDTH;
            more += b ? LOAD(a + next) * LOAD(b + each * next) : LOAD(a + next) - offset;
        }
        for (; e < entries; e++) sum += b ? a[e] * b[each * e] : a[e] - offset;
        if (tile % 8 == 7 || left <= TILE) { /* in parts, so that small terms are not lost */
            sum += total(part + more);
            part = more = (vec){0};
        }
    }
    return sum;
}

/* Each feature's mean over the batch of a, and of b too if there is one: that of equal numbers is
   exactly their value. */
static void mean_batch(const program_t *program, const operation_t *o) {
    double count = (double)program->batch * (o->b.base ? 2 : 1);
    for (int64_t f = 0; f < o->features; f++) {
        float first = o->a.base[f * o->a.feature];
        double sum = sum_of(program, &o->a, 0, f, first);
        if (o->b.base) sum += sum_of(program, &o->b, 0, f, first);
        set_lanes(o->to.base + f * TILE, (float)(first + sum / count));
    }
}

/* Each feature's sum over the batch of a times b. */
static void dot_batch(const program_t *program, const operation_t *o) {
    for (int64_t f = 0; f < o->features; f++)
        set_lanes(o->to.base + f * TILE, (float)sum_of(program, &o->a, &o->b, f, 0));
}

static int has_nan(const program_t *program, const operation_t *o) {
    for (int64_t n = 0; n < program->batch; n++)
        for (int64_t f = 0; f < o->features; f++) {
            int64_t lane = step_of(&o->a) ? n % TILE : 0;
            float x = o->a.base[n / TILE * o->a.tile + f * o->a.feature + lane];
            if (x != x) return 1;
        }
    return 0;
}

static double sum_of_squares(const float *x, int64_t count) {
    double sum = 0;
    int64_t k = 0;
    while (k + WIDTH <= count) { /* in parts, so that small terms are not lost */
        vec part = {0};
        for (int64_t end = k + 64 * WIDTH; k < end && k + WIDTH <= count; k += WIDTH)
            part += LOAD(x + k) * LOAD(x + k);
        sum += total(part);
    }
    for (; k < count; k++) sum += x[k] * x[k];
    return sum;
}

/* Scales gradients of parameters first..last so that their norm is at most that of `a`. */
static void clip_norm(const program_t *program, const operation_t *o) {
    double sum = 0;
    for (int64_t i = o->first; i < o->last; i++) {
        const parameter_t *p = program->parameters + i;
        sum += sum_of_squares(p->grad, p->count);
    }
    float norm = (float)sqrt(sum), factor = *o->a.base / (norm + 1e-6f);
    set_lanes(o->to.base, norm);
    if (factor >= 1) return;
    for (int64_t i = o->first; i < o->last; i++) {
        const parameter_t *p = program->parameters + i;
        for (int64_t k = 0; k < p->count; k++) p->grad[k] *= factor;
    }
}

/* What does not count has no gradient. */
static void mask_grads(const program_t *program, const operation_t *o) {
    for (int64_t i = o->first; i < o->last; i++) {
        const parameter_t *p = program->parameters + i;
        for (int64_t k = 0; p->mask && k < p->count; k++) p->grad[k] = p->mask[k] != 0 ? p->grad[k] : 0;
    }
}

/* What a step does to every number. */
typedef struct {
    vec first, second, squared, rate, root, epsilon, decay, shrink;
} rule_t;

INLINE void adam(const rule_t *s, vec *p, vec *m, vec *v, vec g) {
    *p *= s->shrink;
    if (s->decay[0] != 0) g += s->decay * *p; /* 0 times infinity is no 0 */
    *m += s->first * (g - *m);
    *v = s->second * *v + s->squared * (g * g);
    *p -= s->rate * *m / (root_of(*v) / s->root + s->epsilon);
}

INLINE void rmsprop(const rule_t *s, int within, vec *p, vec *v, vec g) {
    if (s->decay[0] != 0) g += s->decay * *p;
    *v = s->second * *v + s->squared * (g * g);
    *p -= s->rate * g / (within ? root_of(*v + s->epsilon) : root_of(*v) + s->epsilon);
}

static void step_parameter(const parameter_t *p, const group_t *group) {
    double t = *p->steps += 1, rate = group->rate;
    double decay = p->decay + (group->decoupled ? 0 : group->decay), root = 1;
    if (group->optimizer == ADAM) {
        rate /= 1 - pow(group->beta1, t);
        root = sqrt(1 - pow(group->beta2, t));
    }
#define FLOATS(x) ((float)(x) + (vec){0})
    rule_t s = {
        .first = FLOATS(1 - group->beta1), .second = FLOATS(group->beta2),
        .squared = FLOATS(1 - group->beta2), .rate = FLOATS(rate), .root = FLOATS(root),
        .epsilon = FLOATS(group->epsilon), .decay = FLOATS(decay),
        .shrink = FLOATS(group->decoupled ? 1 - group->rate * group->decay : 1),
    };
    for (int64_t k = 0; k < p->count; k += WIDTH) {
        int64_t lanes = p->count - k < WIDTH ? p->count - k : WIDTH;
        vec x = {0}, m = {0}, v = {0}, g = {0};
        int whole = lanes == WIDTH && !p->flat;
        if (whole) {
            x = LOAD(p->number + k), v = LOAD(p->second + k), g = LOAD(p->grad + k);
            if (p->first) m = LOAD(p->first + k);
        } else
            for (int64_t i = 0; i < lanes; i++) {
                int64_t n = p->flat ? p->flat[k + i] : k + i;
                x[i] = p->number[n], v[i] = p->second[n], g[i] = p->grad[k + i];
                if (p->first) m[i] = p->first[n];
            }
        if (group->optimizer == ADAM)
            adam(&s, &x, &m, &v, g);
        else
            rmsprop(&s, group->optimizer == RMSPROP_TF, &x, &v, g);
        if (whole) {
            STORE(p->number + k, x), STORE(p->second + k, v);
            if (p->first) STORE(p->first + k, m);
        } else
            for (int64_t i = 0; i < lanes; i++) {
                int64_t n = p->flat ? p->flat[k + i] : k + i;
                p->number[n] = x[i], p->second[n] = v[i];
                if (p->first) p->first[n] = m[i];
                if (p->packed) p->packed[k + i] = x[i];
            }
    }
}

/* target = (1 - a) * target + a * number, of parameters `last` and `first`. */
static void polyak(const program_t *program, const operation_t *o) {
    const parameter_t *online = program->parameters + o->first, *target = program->parameters + o->last;
    float tau = *o->a.base;
    for (int64_t k = 0; k < online->count; k++) {
        int64_t n = online->flat ? online->flat[k] : k;
        float x = (1 - tau) * target->number[n] + tau * online->number[n];
        target->number[n] = x;
        if (target->packed) target->packed[k] = x;
    }
}

static void pack(const parameter_t *p) {
    for (int64_t k = 0; k < p->count; k++) p->packed[k] = p->number[p->flat[k]];
}

static void turn(const linear_t *layer) {
    int64_t count = layer->row_start[layer->rows];
    for (int64_t k = 0; k < count; k++) layer->turned[k] = layer->value[layer->position[k]];
}

/* Whether it found what must not be. */
static int run_once(const program_t *program, const operation_t *o) {
    where_t where = {.program = program, .entries = WIDTH, .vectors = 1};
    const parameter_t *p = program->parameters + o->number;
    switch (o->kind) {
    case SUM_BATCH: sum_batch(program, o); break;
    case MEAN_BATCH: mean_batch(program, o); break;
    case DOT_BATCH: dot_batch(program, o); break;
    case CHECK: return has_nan(program, o);
    case SPREAD:
        for (int64_t f = 0; f < o->features; f++) set_lanes(o->to.base + f * TILE, p->number[f]);
        break;
    case EXPORT:
        for (int64_t f = 0; f < o->features; f++) p->grad[f] = o->a.base[f * o->a.feature];
        break;
    case STORE:
        for (int64_t f = 0; f < o->features; f++) p->number[f] = o->a.base[f * o->a.feature];
        break;
    case PACK:
        if (p->packed) pack(p);
        break;
    case TURN:
        if (program->layers[o->number].row_start) turn(program->layers + o->number);
        break;
    case MASK_GRADS: mask_grads(program, o); break;
    case CLIP_NORM: clip_norm(program, o); break;
    case OPTIMIZE:
        for (int64_t i = o->first; i < o->last; i++)
            step_parameter(program->parameters + i, program->groups + program->parameters[i].group);
        break;
    case POLYAK: polyak(program, o); break;
    default: run_tiled(o, &where);
    }
    return 0;
}

/* Operations first..last; the number of the check that failed, or -1. */
int64_t NAMED(fused, SUFFIX)(const program_t *program, int64_t first, int64_t last) {
    const operation_t *all = program->operations;
    while (first < last) {
        if (!all[first].tiled) {
            if (run_once(program, all + first)) return first;
            first++;
            continue;
        }
        int64_t end = first;
        while (end < last && all[end].tiled) end++;
        run_phase(program, all + first, all + end);
        first = end;
    }
    return -1;
}
