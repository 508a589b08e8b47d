/* Shares of a batch on torch's own threads. */
#ifndef SB3_SPARSE_THREADS_H
#define SB3_SPARSE_THREADS_H

#include "kernels.h"

#define MOST_SHARES 64

typedef struct {
    void (*work)(void *share);
    char *shares;
    size_t size; /* of a share, in bytes */
    int64_t count;
} job_t;

static void take_shares(void *argument) {
    const job_t *job = argument;
    for (int64_t i = sb3_sparse_openmp.thread(); i < job->count; i += sb3_sparse_openmp.threads())
        job->work(job->shares + i * job->size);
}

static inline void run_shares(void (*work)(void *), void *shares, size_t size, int64_t count) {
    job_t job = {work, shares, size, count};
    if (count > 1 && sb3_sparse_openmp.parallel)
        sb3_sparse_openmp.parallel(take_shares, &job, (unsigned)count, 0);
    else
        for (int64_t i = 0; i < count; i++) work(job.shares + i * size);
}

/* How many shares `tiles` tiles have on `threads` threads. */
static inline int64_t shares_of(int64_t tiles, int64_t threads) {
    int64_t count = threads < tiles ? threads : tiles;
    if (count > MOST_SHARES) count = MOST_SHARES;
    return count < 1 ? 1 : count;
}

/* Adds what another thread has summed up. */
static inline void add_to(float *to, const float *from, int64_t count) {
    for (int64_t i = 0; i < count; i++) to[i] += from[i];
}

#endif
