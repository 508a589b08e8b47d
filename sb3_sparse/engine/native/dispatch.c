/* Chooses the kernels for the processor at run time. */
#include "fused.h"
#include "images.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

#if defined(__x86_64__)
DECLARE(avx512)
DECLARE_FUSED(avx512)
DECLARE_IMAGES(avx512)
DECLARE(avx2)
DECLARE_FUSED(avx2)
DECLARE_IMAGES(avx2)
#endif
DECLARE(plain)
DECLARE_FUSED(plain)
DECLARE_IMAGES(plain)

typedef struct {
    const char *name;
    void (*forward)(const layer_t *, const batch_t *);
    int (*backward)(const layer_t *, const batch_t *);
    int (*act)(const step_t *, int64_t, int64_t, int, const void *, float *);
    int64_t (*fused)(const program_t *, int64_t, int64_t);
    int (*images_forward)(const images_t *, const map_t *, const image_step_t *);
    int (*images_one_by_one)(const images_t *, const map_t *, const image_step_t *);
    int (*images_backward)(const images_t *, const map_t *, const image_step_t *);
} kernels_t;

#define ENTRY(name, suffix)                                                     \
    {name, NAMED(forward, suffix), NAMED(backward, suffix), NAMED(act, suffix), \
     NAMED(fused, suffix), NAMED(images_forward, suffix),                       \
     NAMED(images_one_by_one, suffix), NAMED(images_backward, suffix)}

/* The best first. What is plain on aarch64 is NEON, which every such processor has. */
static const kernels_t all[] = {
#if defined(__x86_64__)
    ENTRY("avx512", avx512),
    ENTRY("avx2", avx2),
#endif
#if defined(__aarch64__)
    ENTRY("neon", plain),
#else
    ENTRY("plain", plain),
#endif
};
#define COUNT ((int)(sizeof all / sizeof *all))

static const kernels_t *chosen;

static int runs_here(const kernels_t *kernels) {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (!strcmp(kernels->name, "avx512"))
        return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
               __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw");
    if (!strcmp(kernels->name, "avx2"))
        return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
    return kernels != 0;
}

#define EXPORT __attribute__((visibility("default")))

/* Changes with every change of what Python hands over. */
EXPORT int sb3_sparse_version(void) { return 14; }

openmp_t sb3_sparse_openmp;

static pthread_key_t at_exit;
static pthread_once_t once = PTHREAD_ONCE_INIT;
static void make_key(void) { pthread_key_create(&at_exit, free); }

float *sb3_sparse_scratch(size_t size) {
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

/* Share these threads from now on; without them there is one. */
EXPORT void sb3_sparse_share_threads(void *parallel, void *thread, void *threads) {
    memcpy(&sb3_sparse_openmp.parallel, &parallel, sizeof parallel);
    memcpy(&sb3_sparse_openmp.thread, &thread, sizeof thread);
    memcpy(&sb3_sparse_openmp.threads, &threads, sizeof threads);
}

/* 1 where there is more than one thread to be had. */
EXPORT int sb3_sparse_shares_threads(void) { return sb3_sparse_openmp.parallel != 0; }

/* Name of the i-th instruction set that runs here, the best first; NULL where there are no more. */
EXPORT const char *sb3_sparse_instructions(int i) {
    for (int k = 0; k < COUNT; k++)
        if (runs_here(all + k) && i-- == 0) return all[k].name;
    return 0;
}

/* Use the kernels of that name from now on; 0 if they run here, else -1 and nothing changes. */
EXPORT int sb3_sparse_use(const char *name) {
    for (int k = 0; k < COUNT; k++)
        if (!strcmp(all[k].name, name) && runs_here(all + k)) {
            chosen = all + k;
            return 0;
        }
    return -1;
}

EXPORT void sb3_sparse_forward(const layer_t *layers, const batch_t *batch) {
    chosen->forward(layers, batch);
}

/* -1 if there is no memory for it, else 0. */
EXPORT int sb3_sparse_backward(const layer_t *layers, const batch_t *batch) {
    return chosen->backward(layers, batch);
}

/* 1 if a result holds a NaN, -1 if there is no memory for it, else 0. */
EXPORT int sb3_sparse_act(const step_t *steps, int64_t count, int64_t batch, int doubles,
                          const void *x, float *y) {
    return chosen->act(steps, count, batch, doubles, x, y);
}

/* Operations first..last of a program; the number of the check that failed, or -1. */
EXPORT int64_t sb3_sparse_fused(const program_t *program, int64_t first, int64_t last) {
    return chosen->fused(program, first, last);
}

/* -1 if there is no memory for it, else 0. */
EXPORT int sb3_sparse_images_forward(const images_t *images, const map_t *maps, const image_step_t *steps) {
    return chosen->images_forward(images, maps, steps);
}

/* The same for a few images, where no backward pass follows. */
EXPORT int sb3_sparse_images_one_by_one(const images_t *images, const map_t *maps, const image_step_t *steps) {
    return chosen->images_one_by_one(images, maps, steps);
}

/* -1 if there is no memory for it, else 0. */
EXPORT int sb3_sparse_images_backward(const images_t *images, const map_t *maps, const image_step_t *steps) {
    return chosen->images_backward(images, maps, steps);
}

/* Sets inactive weights to 0, except NaN and infinities, which become NaN and stay visible. */
EXPORT void sb3_sparse_clear(float *weight, const float *mask, int64_t count) {
    for (int64_t i = 0; i < count; i++) weight[i] *= mask[i];
}

/* Actions mean + std * noise (without noise: the mean) of `count` Gaussians of `size` dimensions, and
   behind them their log probabilities. 1 if one is not finite, else 0. */
EXPORT int sb3_sparse_gaussian(int64_t count, int64_t size, const float *mean, const float *log_std,
                               const float *noise, float *action) {
    float wrong = 0, *log_prob = action + count * size;
    for (int64_t n = 0; n < count; n++) {
        log_prob[n] = 0;
        for (int64_t d = 0; d < size; d++) {
            float centre = mean[n * size + d], std = expf(log_std[d]);
            float a = noise ? centre + std * noise[n * size + d] : centre;
            float away = (a - centre) / std;
            action[n * size + d] = a;
            log_prob[n] -= away * away / 2 + log_std[d] + 0.918938533f; /* ln sqrt(2 pi) */
        }
        wrong += log_prob[n] - log_prob[n];
    }
    return wrong != wrong;
}

/* Actions of a box with bounds of `size` dimensions, each step rounded as NumPy rounds it: clipped (0), from
   [-1, 1] to the bounds (1), or from the bounds to [-1, 1] (2). `count` numbers in all. */
EXPORT void sb3_sparse_box(int how, int64_t count, int64_t size, const float *low, const float *high,
                           const float *from, float *to) {
    for (int64_t i = 0, d = 0; i < count; i++, d = d + 1 < size ? d + 1 : 0) {
        float a = from[i], width = high[d] - low[d];
        if (how == 0) {
            a = a < low[d] ? low[d] : a;
            to[i] = a > high[d] ? high[d] : a;
        } else if (how == 1) {
            volatile float above = 0.5f * (a + 1.0f) * width; /* no fused multiply-add */
            to[i] = low[d] + above;
        } else {
            volatile float twice = 2.0f * ((a - low[d]) / width);
            to[i] = twice - 1.0f;
        }
    }
}

/* u = mean + e^log_std * noise (without noise: the mean), element by element, and behind them actions
   tanh(u); log_std is brought into its bounds. 1 if one is not finite, else 0. */
EXPORT int sb3_sparse_squashed(int64_t count, double least, double most, const float *mean,
                               float *log_std, const float *noise, float *gaussian) {
    float *action = gaussian + count;
    float wrong = 0, low = (float)least, high = (float)most;
    for (int64_t i = 0; i < count; i++) {
        log_std[i] = log_std[i] < low ? low : log_std[i] > high ? high : log_std[i];
        gaussian[i] = noise ? mean[i] + expf(log_std[i]) * noise[i] : mean[i];
        action[i] = tanhf(gaussian[i]);
        wrong += gaussian[i] - gaussian[i];
    }
    return wrong != wrong;
}
