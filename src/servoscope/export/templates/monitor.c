/*
 * Condition monitoring of the loop "@{loop}"; see @{prefix}.h.
 *
 * Made by servoscope @{version} from the baseline @{hash}. This file is yours, as @{prefix}.h says.
 *
 * Every operation of the numbers below stands in a statement of its own, and where two are one (fma) the text says so:
 * the results have the same bits as the monitor's on the server. What no C99 compiler may do, and some do when they are
 * told to, is to join or reorder them: compile with -ffp-contract=off or the like.
 */
#include "@{prefix}.h"

#include <float.h>
#include <math.h>
#include <string.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ > 0))
#error "compile without -ffast-math and its like: results would have other bits, and NaN would not be seen"
#endif
#if FLT_EVAL_METHOD != 0
#error "compile for a processor that computes doubles as doubles (x87: give -msse2 -mfpmath=sse)"
#endif
#if DBL_MANT_DIG != 53
#error "a double has to be an IEEE 754 binary64"
#endif
#if defined(__clang__) || !defined(__GNUC__)
#pragma STDC FP_CONTRACT OFF
#endif

/* places in the state */
#define SAMPLE @{sample}
#define ARMED @{armed}
@@ for i, place in places.items() if " " not in place
#define @{place} @{i}
@@ endfor
@@ if size.watched
#define CUSUMS @{size.floats}
@@ endif
@@ if not size.steady
#define PRIVATE @{size.floats + size.watched}
@@ endif
@@ if made.covariates
#define AT_COVARIATES @{covariate_place}
@@ endif
/* status of a sample */
#define MISSING (-1.0)
#define USED 1.0
#define BETWEEN 2.0

#define MAX_PHYSICAL @{max_physical}
#define STRIDE @{stride}u /* samples per update */
#define LIMIT @{made.baseline.thresholds.statistic | c(single)}
#define ON_DELAY @{on_delay}.0 /* evaluations */
#define OFF_DELAY @{off_delay}.0

static const @{number} c[@{made.table | length}] = {
@@ for begin, end, name in sections
    /* @{begin}: @{name} */
@{made.table[begin:end].tolist() | map("c", single) | wrapped},
@@ endfor
};

const double @{prefix}_frequencies[@{upper}_FREQUENCIES] = {@{made.baseline.loop.monitor.frequencies | map("c") | join(", ")}};
const @{number} @{prefix}_limit = LIMIT;

static const @{prefix}_residual healthy[@{upper}_FREQUENCIES] = {
@@ for H in made.healthy.H
    {@{H.real | c(single)}, @{H.imag | c(single)}}@{"" if loop.last else ","}
@@ endfor
};

static const unsigned char fingerprint[8] = {@{mark | join(", ")}};

@{functions | join("\n\n")}

/* Take one sample through filters, estimator, covariance and sequential test. */
static void process(@{prefix}_state *state, @{number} r, @{number} u, @{number} y, double restart)
{
    double *h = state->counters;
    @{number} *s = state->numbers;
    @{number} v[@{size.rows}] = {@{([zero] * size.rows) | join(", ")}};
    @{number} shadow[@{made.spec.shadow_rows}] = {@{([zero] * made.spec.shadow_rows) | join(", ")}};
    @{number} e[2] = {@{zero}, @{zero}};
    double status[1] = {MISSING};
@@ if size.watched
    @{number} *g = &s[CUSUMS];
    @{number} top[1];
@@ endif
@@ if size.watched and not made.spec.sums
    @{number} w[@{made.spec.columns + 1}];
    double when[1];
@@ endif
    const uint64_t number = (uint64_t)h[SAMPLE];
    const int due = ((number + 1u) % STRIDE) == 0u;

@@ if size.shadow
    if ((number % @{every}u) == 0u) {
        begin_evaluation(s, h);
    }
@@ endif
    h[SAMPLE] = h[SAMPLE] + 1.0;
    if ((@{fabs}(r) < MAX_PHYSICAL) && (@{fabs}(u) < MAX_PHYSICAL) && (@{fabs}(y) < MAX_PHYSICAL)) {
        if ((restart > 0.0) || (h[ARMED] <= 0.0)) {
            begin_filters(s, h, r, u, y, restart);
        }
        advance_filters(s, h, v, shadow, status, r, u, y, restart, due);
    } else {
        h[ARMED] = 0.0;
        status[0] = MISSING;
    }
    if ((status[0] >= USED) && (status[0] <= USED)) {
        update_estimate(s, h, v, shadow, e@{"" if size.steady else ", &state->numbers[PRIVATE]"});
    } else if (status[0] < BETWEEN) {
        reset_noise(s, h);
    } else {
        /* between two updates */
    }
@@ if size.watched and made.spec.sums
    if (((number + 1u) % @{every}u) == 0u) {
        top[0] = update_cusums(g, &s[AT_SUMS]);
        end_evaluation(s, h, top);
    }
@@ elif size.watched
    store_residual(s, h, status, e, w, when);
    top[0] = update_cusums(g, w);
    update_alarm(s, h, top, when);
@@ endif
}

@@ if made.covariates
@@ include "covariates.c"
@@ endif
/* Count how long statistics have been above their limits; return the verdict. */
static @{prefix}_verdict judge(@{prefix}_state *state, const @{prefix}_evaluation *q)
{
    const int ready = @{"(q->updates > 0.0) && (q->place == " ~ upper ~ "_KNOWN)" if made.covariates else "q->updates > " ~ zero};
    const int exceeded = ready && ((q->statistic > LIMIT) || (q->level >= @{one}));
    @{prefix}_verdict verdict = @{upper}_WAITING;

    state->exceeding = (exceeded != 0) ? (state->exceeding + 1.0) : 0.0;
    if (state->exceeding > ON_DELAY) {
        state->since = 0.0;
    } else if (state->since <= OFF_DELAY) {
        state->since = state->since + 1.0;
    } else {
        /* no alarm that could end */
    }
    if (ready != 0) {
        verdict = (state->since <= OFF_DELAY) ? @{upper}_FAULT : @{upper}_HEALTHY;
    }
    return verdict;
}

static int sample(@{prefix}_state *state, @{number} r, @{number} u, @{number} y, double restart,
                  @{prefix}_evaluation *q)
{
    int due;
    int f;
@% if made.covariates %@    double average[@{upper}_COVARIATES];
    const int known = follow_covariates(state, average);
@% endif %@
    process(state, @{"(known != 0) ? r : (double)NAN" if made.covariates else "r"}, u, y, restart);
    due = ((uint64_t)state->counters[SAMPLE] % @{upper}_EVERY) == 0u;
    if (due != 0) {
        evaluate(state->numbers, state->counters, q);
        for (f = 0; f < @{upper}_FREQUENCIES; f++) {
            q->gamma[f].real = q->response[f].real - healthy[f].real;
            q->gamma[f].imag = q->response[f].imag - healthy[f].imag;
        }
@@ if made.covariates
        compare_covariates(average, known, q);
@@ endif
        q->verdict = judge(state, q);
    }
    return due;
}

void @{prefix}_init(@{prefix}_state *state)
{
    size_t i;

    for (i = 0; i < @{upper}_COUNTERS; i++) {
        state->counters[i] = 0.0;
    }
    for (i = 0; i < @{upper}_NUMBERS; i++) {
        state->numbers[i] = @{zero};
    }
@@ for value in start.tolist()
@@ if value
    state->numbers[@{places.get(loop.index0, loop.index0)}] = @{value | c(single)};
@@ endif
@@ endfor
    state->exceeding = 0.0;
    state->since = OFF_DELAY + 1.0;
}

void @{prefix}_restart(@{prefix}_state *state)
{
    state->counters[ARMED] = 0.0;
}

int @{prefix}_step(@{prefix}_state *state, @{number} r, @{number} u, @{number} y, @{prefix}_evaluation *q)
{
    return sample(state, r, u, y, 0.0, q);
}

size_t @{prefix}_block(@{prefix}_state *state, size_t count, const @{number} *r, const @{number} *u, const @{number} *y,
                       const unsigned char *restart, @{prefix}_evaluation *q, size_t room)
{
    @{prefix}_evaluation unwanted;
    size_t found = 0;
    size_t k;

    for (k = 0; k < count; k++) {
        const int apart = (restart != NULL) && (restart[k] != 0u);

        if (sample(state, r[k], u[k], y[k], (apart != 0) ? 1.0 : 0.0, (found < room) ? &q[found] : &unwanted) != 0) {
            found++;
        }
    }
    return found;
}

@@ include "frozen.c"
/* CRC-32 of IEEE 802.3, bit by bit: a table would be a kilobyte of constants. */
static uint32_t checksum(const unsigned char *bytes, size_t count)
{
    uint32_t crc = 0xFFFFFFFFu;
    size_t i;
    int bit;

    for (i = 0; i < count; i++) {
        crc ^= (uint32_t)bytes[i];
        for (bit = 0; bit < 8; bit++) {
            crc = ((crc & 1u) != 0u) ? ((crc >> 1) ^ 0xEDB88320u) : (crc >> 1);
        }
    }
    return crc ^ 0xFFFFFFFFu;
}

static void write_number(double number, unsigned char *bytes)
{
    uint64_t bits;
    unsigned int i;

    (void)memcpy(&bits, &number, sizeof bits);
    for (i = 0; i < 8u; i++) {
        bytes[i] = (unsigned char)(bits & 0xFFu);
        bits = bits >> 8;
    }
}

static double read_number(const unsigned char *bytes)
{
    uint64_t bits = 0;
    double number;
    int i;

    for (i = 7; i >= 0; i--) {
        bits = (bits << 8) | (uint64_t)bytes[i];
    }
    (void)memcpy(&number, &bits, sizeof number);
    return number;
}

void @{prefix}_save(const @{prefix}_state *state, unsigned char image[@{upper}_IMAGE_BYTES])
{
    const size_t end = @{upper}_IMAGE_BYTES - 4u;
    uint32_t crc;
    size_t i;

    for (i = 0; i < @{upper}_COUNTERS; i++) {
        write_number(state->counters[i], &image[8u * i]);
    }
    for (i = 0; i < @{upper}_NUMBERS; i++) {
        write_number((double)state->numbers[i], &image[8u * (@{upper}_COUNTERS + i)]);
    }
    write_number(state->exceeding, &image[8u * @{upper}_STATE_NUMBERS]);
    write_number(state->since, &image[(8u * @{upper}_STATE_NUMBERS) + 8u]);
    for (i = 0; i < 8u; i++) {
        image[(end - 8u) + i] = fingerprint[i];
    }
    crc = checksum(image, end);
    for (i = 0; i < 4u; i++) {
        image[end + i] = (unsigned char)((crc >> (8u * i)) & 0xFFu);
    }
}

int @{prefix}_load(@{prefix}_state *state, const unsigned char image[@{upper}_IMAGE_BYTES])
{
    const size_t end = @{upper}_IMAGE_BYTES - 4u;
    const uint32_t crc = checksum(image, end);
    int good = 1;
    size_t i;

    for (i = 0; i < 8u; i++) {
        if (image[(end - 8u) + i] != fingerprint[i]) {
            good = 0;
        }
    }
    for (i = 0; i < 4u; i++) {
        if (image[end + i] != (unsigned char)((crc >> (8u * i)) & 0xFFu)) {
            good = 0;
        }
    }
    if (good != 0) {
        for (i = 0; i < @{upper}_COUNTERS; i++) {
            state->counters[i] = read_number(&image[8u * i]);
        }
        for (i = 0; i < @{upper}_NUMBERS; i++) {
            state->numbers[i] = (@{number})read_number(&image[8u * (@{upper}_COUNTERS + i)]);
        }
        state->exceeding = read_number(&image[8u * @{upper}_STATE_NUMBERS]);
        state->since = read_number(&image[(8u * @{upper}_STATE_NUMBERS) + 8u]);
    }
    return good;
}
