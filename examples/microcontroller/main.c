/*
 * Steps the policy on recorded observations. For each it prints the action, the bits of its floats
 * in hexadecimal, and the ticks of the timer that it took, or ffffffff for more than it can count;
 * at the end the most bytes of stack.
 */
#include <stdint.h>

#include "board.h"

#include <observations.h> /* of the folder IN, whatever lies beside this file */
#include <policy.h>

/* What --with-value and --stochastic add; it is computed, and not printed. */
#ifdef SB3_SPARSE_VALUE_SIZE
static float value[SB3_SPARSE_VALUE_SIZE];
#define VALUE , value
#else
#define VALUE
#endif
#ifdef SB3_SPARSE_MEAN_SIZE
static float mean[SB3_SPARSE_MEAN_SIZE], std[SB3_SPARSE_STD_SIZE];
#define DISTRIBUTION , mean, std
#elif defined SB3_SPARSE_LOGITS_SIZE
static float logits[SB3_SPARSE_LOGITS_SIZE];
#define DISTRIBUTION , logits
#else
#define DISTRIBUTION
#endif

#define PAINT 0x5AFEC0DEu
#define PAINTED 512 /* words of stack that are watched */

static void print_number(uint32_t number, const char *after)
{
    char digits[9];
    int i;

    for (i = 7; i >= 0; i--, number >>= 4)
        digits[i] = "0123456789abcdef"[number & 15u];
    digits[8] = '\0';
    print(digits);
    print(after);
}

static inline uint32_t *stack_pointer(void)
{
    uint32_t *sp;

    __asm__ volatile("mov %0, sp" : "=r"(sp));
    return sp;
}

int main(void)
{
    union {
        float value;
        uint32_t bits;
    } number;
    float action[SB3_SPARSE_ACTION_SIZE];
    uint32_t *word, *top = stack_pointer();
    uint32_t i, j, start, spent, used, most = 0;

    for (i = 0; i < OBSERVATIONS; i++) {
        for (word = top - PAINTED; word < top; word++)
            *word = PAINT;
        start_ticks();
        start = ticks();
        sb3_sparse_policy(observations[i], action VALUE DISTRIBUTION);
        spent = (start - ticks()) & 0xFFFFFFu;
        if (ran_out())
            spent = 0xFFFFFFFFu;
        for (word = top - PAINTED; word < top && *word == PAINT; word++)
            ;
        used = (uint32_t)(top - word) * 4u;
        most = used > most ? used : most;
        for (j = 0; j < SB3_SPARSE_ACTION_SIZE; j++) {
            number.value = action[j];
            print_number(number.bits, " ");
        }
        print_number(spent, "\n");
    }
    print("stack ");
    print_number(most, "\n");
    return 0;
}
