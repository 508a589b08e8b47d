/* Chooses the kernels for the processor at run time. */
#include "kernels.h"

#include <string.h>

#if defined(__x86_64__)
DECLARE(avx512)
DECLARE(avx2)
#endif
DECLARE(plain)

typedef struct {
    const char *name;
    void (*forward)(const layer_t *, const batch_t *);
    int (*backward)(const layer_t *, const batch_t *);
    void (*single)(const layer_t *, const float *, float *);
} kernels_t;

#define ENTRY(name, suffix) {name, NAMED(forward, suffix), NAMED(backward, suffix), NAMED(single, suffix)}

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
EXPORT int sb3_sparse_version(void) { return 1; }

openmp_t sb3_sparse_openmp;

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

/* One input through a chain; `spare` has room for two of its widest outputs. */
EXPORT void sb3_sparse_single(const layer_t *layers, int64_t count, const float *x, float *spare,
                              float *y) {
    int64_t widest = 0;
    for (int64_t l = 0; l < count; l++)
        if (layers[l].rows > widest) widest = layers[l].rows;
    for (int64_t l = 0; l < count; l++) {
        float *to = l == count - 1 ? y : spare + (l % 2) * widest;
        chosen->single(layers + l, x, to);
        x = to;
    }
}
