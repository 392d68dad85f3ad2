/*
 * Condition monitoring of one servo loop, from reference r, control input u and measured output y.
 *
 * Made by servoscope @{version} from the baseline @{hash} of the loop "@{loop}".@{left_out}@{rounding}
 * This file and @{prefix}.c are yours: use, change and pass them on as you like; no licence of servoscope applies.
 *
 * No memory is allocated, nothing is recursive, every loop is bounded, and all state is in one struct. Of the C library
 * fma, fabs, sqrt@{", exp" if made.covariates} and memcpy are called. A double has to be an IEEE 754 binary64; rounding is to nearest, subnormal
 * numbers are kept (no flush to zero), and no option such as -ffast-math may be given.
 */
#ifndef @{upper}_H
#define @{upper}_H

#include <stddef.h>
#include <stdint.h>

#define @{upper}_SAMPLE_RATE_HZ @{made.baseline.loop.sample_rate | c} /* of r, u and y */
#define @{upper}_EVERY @{every}u /* samples per evaluation */
#define @{upper}_COEFFICIENTS @{size.n}
#define @{upper}_FREQUENCIES @{size.frequencies}
#define @{upper}_STATE_NUMBERS @{made.start | length}u /* of the state of the monitor, as the program on the server keeps it */
#define @{upper}_COUNTERS @{header}u /* of them, at the head; the others follow */
#define @{upper}_NUMBERS (@{upper}_STATE_NUMBERS - @{upper}_COUNTERS)
#define @{upper}_ROW @{size.row} /* numbers at the head of an evaluation */
#define @{upper}_CONSTANT_BYTES @{constant_bytes}
#define @{upper}_IMAGE_BYTES @{image_bytes}u /* of a saved state */

/* State between two samples. Set it up with @{prefix}_init or @{prefix}_load. */
typedef struct {
    double counters[@{upper}_COUNTERS]; /* samples, updates and the like: exact up to 2^53 */
    @{number} numbers[@{upper}_NUMBERS];
    double exceeding; /* evaluations above a limit without interruption */
    double since;     /* evaluations since the alarm was last raised; no more than the off-delay + 1 */
} @{prefix}_state;

/*
 * For how many samples y or u may stay exactly the same while the motion demands a change, and how far r has to move for
 * y to be expected to follow [@{y_unit}]; 0: a tenth of the range that y itself has covered.
 */
#ifndef @{upper}_FROZEN_SAMPLES
#define @{upper}_FROZEN_SAMPLES @{limits.frozen}u
#endif
#ifndef @{upper}_FROZEN_TRAVEL
#define @{upper}_FROZEN_TRAVEL 0.0
#endif
#define @{upper}_FROZEN_Y 1
#define @{upper}_FROZEN_U 2

/* What @{prefix}_frozen knows of the signals; of r, u, y and, where there are four, r - y. */
typedef struct {
    uint32_t samples;     /* since ranges were last forgotten */
    uint32_t turns;       /* of y at rest */
    int started;          /* 1: there are values */
    int noisy;            /* 1: y is known to move at rest */
    int frozen_y;         /* 1: found */
    int frozen_u;         /* 1: found */
    uint64_t same[3];     /* samples for which it has stayed the same */
    uint64_t u_changes;   /* changes of u, and samples, since it last was the same for long */
    uint64_t u_samples;
    double last[3];
    double smallest_change[3];
    double direction;     /* last change of y */
    double ranges[2][4][2]; /* lowest and highest: since they were last forgotten, and in the time before */
    double r_while_y[2];  /* lowest and highest of r while y stays the same; */
    double y_while_u[2];  /* of y while u does; */
    double e_while_u[2];  /* of r - y while u does; */
    double y_at_rest[2];  /* of y while r does */
} @{prefix}_signals;

/* What is known of the actuator. */
typedef enum {
    @{upper}_WAITING = 0, /* there is no estimate yet */
    @{upper}_HEALTHY = 1,
    @{upper}_FAULT = 2 /* a statistic has been above its limit for longer than the on-delay, @{on_delay} evaluations, */
                       /* and for no longer than the off-delay, @{off_delay} evaluations, below it since */
} @{prefix}_verdict;

/* The inverse frequency response at one frequency, u over y, [@{response_unit}]. */
typedef struct {
    @{number} real;
    @{number} imag;
    @{number} variance_real;
    @{number} covariance; /* of real and imaginary part */
    @{number} covariance_again;
    @{number} variance_imag;
} @{prefix}_response;

/* The estimated minus the healthy response, [@{response_unit}]. */
typedef struct {
    @{number} real;
    @{number} imag;
} @{prefix}_residual;

@@ if made.covariates
@@ include "covariates_interface.c"
@@ endif
/* One evaluation. */
typedef struct {
    @{number} updates;   /* samples that the estimate has taken so far */
    @{number} statistic; /* T^2; its limit is @{prefix}_limit */
    @{number} level;     /* of the sequential test, largest since the evaluation before; its limit is 1 */
    @{number} crossed_s; /* time of the first sample at which it passed its limit, [s] since the start; NaN: it has not */
    @{number} theta[@{upper}_COEFFICIENTS]; /* @{units} */
    @{number} covariance[@{upper}_COEFFICIENTS * @{upper}_COEFFICIENTS]; /* of theta, row by row */
    @{prefix}_response response[@{upper}_FREQUENCIES];
    @{prefix}_residual gamma[@{upper}_FREQUENCIES];
    @{prefix}_verdict verdict;
@@ if made.covariates
    @{prefix}_place place;
@@ endif
} @{prefix}_evaluation;

/* The monitored frequencies, [Hz], and the limit of T^2. */
extern const double @{prefix}_frequencies[@{upper}_FREQUENCIES];
extern const @{number} @{prefix}_limit;

/* Make the state before the first sample. */
void @{prefix}_init(@{prefix}_state *state);

@@ if made.covariates
/*
 * Say what the covariates are from the next sample on, in the units of the recordings; NaN is no new value of one.
 * Call it before each sample, or as often as there are new values.
 */
void @{prefix}_covariates(@{prefix}_state *state, const double values[@{upper}_COVARIATES]);

@@ endif
/* Say that the next sample does not follow the one before by one sample time. */
void @{prefix}_restart(@{prefix}_state *state);

/*
 * Take one sample: r [@{y_unit}], u [@{u_unit}], y [@{y_unit}]. NaN in any of them, or a magnitude of 1e100 and more,
 * is a missing sample: the estimate is held, and the filters begin anew behind it.
 *
 * Return 1 if an evaluation was due and has been written to q, else 0, and q is left as it is.
 */
int @{prefix}_step(@{prefix}_state *state, @{number} r, @{number} u, @{number} y, @{prefix}_evaluation *q);

/*
 * Take `count` samples as @{prefix}_step does, with restarts where `restart` is not 0; it may be NULL.
 *
 * Return how many evaluations were due; no more than `room` of them, the first ones, are written to q.
 */
size_t @{prefix}_block(@{prefix}_state *state, size_t count, const @{number} *r, const @{number} *u, const @{number} *y,
                       const unsigned char *restart, @{prefix}_evaluation *q, size_t room);

/* Make what is known of the signals before the first sample. It is not saved: behind a power loss it begins anew. */
void @{prefix}_signals_init(@{prefix}_signals *signals);

/*
 * Look at a sample for frozen signals, before or behind @{prefix}_step; NaN or an infinity is a missing sample.
 *
 * Return 0, or @{upper}_FROZEN_Y, @{upper}_FROZEN_U or their sum while a signal is frozen. No verdict holds then.
 */
int @{prefix}_frozen(@{prefix}_signals *signals, @{number} r, @{number} u, @{number} y);

/* Write the state to an image, the same on every machine: little-endian doubles, fingerprint of this baseline, CRC-32. */
void @{prefix}_save(const @{prefix}_state *state, unsigned char image[@{upper}_IMAGE_BYTES]);

/* Read an image. Return 1; 0 if it is damaged or of another baseline, and the state is left as it is. */
int @{prefix}_load(@{prefix}_state *state, const unsigned char image[@{upper}_IMAGE_BYTES]);

#endif
