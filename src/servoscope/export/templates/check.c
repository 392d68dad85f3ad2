/*
 * Self-test of @{prefix}.c: the golden samples have to lead to the golden results, @{"T^2 within " ~ tolerance if made.covariates else "bit by bit"}.
 * Run it with `make check`.
 *
 * It prints the bytes of state and constants and the time of a sample, in cycles too where it knows a counter of them,
 * and returns 0 if all is as it should be.
 */
#include <math.h>

#include "@{prefix}.h"
#include "@{prefix}_golden.h"

#include <stdio.h>
#include <string.h>
#include <time.h>

#ifndef CYCLES /* a counter of the processor, as "-DCYCLES=(*(volatile uint32_t *)0xE0001004)" on a Cortex-M7 */
#if defined(__GNUC__) && defined(__x86_64__)
#define CYCLES __builtin_ia32_rdtsc()
#endif
#endif

#define MAX_PASSES 50 /* over the golden samples, to measure the time; they end after a second */

static @{number} from_bits(@{bits} bits)
{
    @{number} number;

    memcpy(&number, &bits, sizeof number);
    return number;
}

#ifdef GOLDEN_TOLERANCE
/* Return whether a statistic is not the golden one. */
static int is_wrong(const @{prefix}_evaluation *q, size_t at)
{
    const double error = q->statistic - golden_statistics[at];
    const double allowed = GOLDEN_TOLERANCE * (1.0 + golden_statistics[at]);

    return !((error <= allowed) && (-error <= allowed));
}
#else
/* FNV-1a over the bits of numbers. */
static uint64_t digest(const @{number} *numbers, size_t count)
{
    uint64_t hash = 14695981039346656037u;
    size_t i;
    int byte;

    for (i = 0; i < count; i++) {
        @{bits} bits;

        memcpy(&bits, &numbers[i], sizeof bits);
        for (byte = 0; byte < (int)sizeof bits; byte++) {
            hash ^= (bits >> (8 * byte)) & 0xFFu;
            hash *= 1099511628211u;
        }
    }
    return hash;
}

/* Return whether the numbers of an evaluation have other bits than the golden ones. */
static int is_wrong(const @{prefix}_evaluation *q, size_t at)
{
    @{number} row[@{upper}_ROW];

    memcpy(row, q, sizeof row);
    return digest(row, @{upper}_ROW) != golden_evaluations[at];
}
#endif

static @{number} r[GOLDEN_SAMPLES];
static @{number} u[GOLDEN_SAMPLES];
static @{number} y[GOLDEN_SAMPLES];

/*
 * Return 0 if the check for frozen signals is right, over the golden samples again and again; of four stretches of the
 * same length, y is held at one value in the second, and u in the last.
 */
static size_t check_frozen(void)
{
    static @{prefix}_signals signals;
    uint64_t hash = 14695981039346656037u;
    size_t k;

    @{prefix}_signals_init(&signals);
    for (k = 0; k < (4u * GOLDEN_STRETCH); k++) {
        const size_t at = k % GOLDEN_SAMPLES;
        const size_t held = GOLDEN_HELD;
        const size_t stretch = k / GOLDEN_STRETCH;
        const int found =
            @{prefix}_frozen(&signals, r[at], u[(stretch == 3u) ? held : at], y[(stretch == 1u) ? held : at]);

        hash ^= (uint64_t)found;
        hash *= 1099511628211u;
    }
    return (hash != GOLDEN_FROZEN) ? 1u : 0u;
}

int main(void)
{
    static @{prefix}_state state;
    static @{prefix}_evaluation q;
    static unsigned char image[@{upper}_IMAGE_BYTES];
    size_t evaluations = 0;
    size_t wrong = 0;
    size_t first = 0;
    size_t k;
    int pass;
    int intact;
    clock_t begin;
#ifdef CYCLES
    uint32_t cycles;
#endif

    for (k = 0; k < GOLDEN_SAMPLES; k++) {
        r[k] = from_bits(golden_samples[k][0]);
        u[k] = from_bits(golden_samples[k][1]);
        y[k] = from_bits(golden_samples[k][2]);
    }
    @{prefix}_init(&state);
    for (k = 0; k < GOLDEN_SAMPLES; k++) {
        if (golden_restart[k] != 0u) {
            @{prefix}_restart(&state);
        }
#ifdef GOLDEN_TOLERANCE
        @{prefix}_covariates(&state, golden_covariates[k]);
#endif
        if (@{prefix}_step(&state, r[k], u[k], y[k], &q) != 0) {
            if ((is_wrong(&q, evaluations) != 0) || ((int)q.verdict != (int)golden_verdicts[evaluations])) {
                if (wrong == 0u) {
                    first = k;
                }
                wrong++;
            }
            evaluations++;
        }
        if (k == GOLDEN_SAMPLES / 2u) { /* through a power loss */
            @{prefix}_save(&state, image);
            @{prefix}_init(&state);
            if (@{prefix}_load(&state, image) == 0) {
                wrong++;
            }
        }
    }
    @{prefix}_save(&state, image);
#ifdef GOLDEN_TOLERANCE
    if (@{prefix}_load(&state, golden_image) == 0) {
        wrong++;
    }
#else
    if (memcmp(image, golden_image, sizeof image) != 0) {
        wrong++;
    }
#endif
    image[5] ^= 1u;
    intact = @{prefix}_load(&state, image);
    if (intact != 0) {
        wrong++;
    }
    wrong += check_frozen();
    begin = clock();
    for (pass = 0; (pass < MAX_PASSES) && ((pass == 0) || ((clock() - begin) < CLOCKS_PER_SEC)); pass++) {
        evaluations += @{prefix}_block(&state, GOLDEN_SAMPLES, r, u, y, golden_restart, &q, 1);
    }
    printf("state %lu bytes, saved %lu, of signals %lu, constants %lu\n", (unsigned long)sizeof(@{prefix}_state),
           (unsigned long)@{upper}_IMAGE_BYTES, (unsigned long)sizeof(@{prefix}_signals),
           (unsigned long)@{upper}_CONSTANT_BYTES);
    printf("%.0f ns per sample\n",
           (1e9 * (double)(clock() - begin)) / (double)CLOCKS_PER_SEC / (double)pass / (double)GOLDEN_SAMPLES);
#ifdef CYCLES
    cycles = (uint32_t)CYCLES;
    evaluations += @{prefix}_block(&state, GOLDEN_SAMPLES, r, u, y, golden_restart, &q, 1);
    cycles = (uint32_t)CYCLES - cycles; /* right though the counter begins anew in between */
    printf("%.0f cycles per sample\n", (double)cycles / (double)GOLDEN_SAMPLES);
#endif
    if ((wrong != 0u) || (evaluations == 0u)) {
        printf("WRONG: %lu results differ, the first at sample %lu\n", (unsigned long)wrong, (unsigned long)first);
        return 1;
    }
    printf("ok: %d samples, %d evaluations, @{"T^2 within " ~ tolerance if made.covariates else "bit by bit"}\n", GOLDEN_SAMPLES, GOLDEN_EVALUATIONS);
    return 0;
}
