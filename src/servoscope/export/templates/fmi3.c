/*
 * Co-simulation interface, FMI 3.0, of the monitor in @{prefix}.c. It is for simulators on a computer, not for a drive.
 *
 * A step lasts one sample time and takes one sample: the inputs as they were set before the step. This file is yours, as
 * @{prefix}.h says. Types are those of the standard's headers, which are not needed.
 */
#include "@{prefix}.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define PUBLIC __declspec(dllexport)
#else
#define PUBLIC __attribute__((visibility("default")))
#endif

#define SAMPLE_TIME (1.0 / @{upper}_SAMPLE_RATE_HZ)
#define STEP_TOLERANCE 1e-3 /* of the sample time: communication points are sums of floating-point numbers */
#define TOKEN "@{token}"

typedef enum { OK = 0, WARNING = 1, DISCARD = 2, ERROR = 3, FATAL = 4 } Status;
typedef uint32_t Reference;
typedef void (*Log)(void *environment, int status, const char *category, const char *message);

/* value references; the numbers of an evaluation follow NUMBERS in the order of their struct */
enum { TIME = 0, R = 1, U = 2, Y = 3, RESTART = 4, VERDICT = 5, EVALUATIONS = 6, LIMIT = 7, NUMBERS = 10 };
#define COUNT (@{upper}_ROW + 2 * @{upper}_FREQUENCIES)

typedef struct {
    double time;
    double input[3]; /* r, u, y */
    bool restart;
    uint64_t evaluations;
    @{prefix}_evaluation q;
} Surroundings; /* of the monitor's state */

typedef struct {
    @{prefix}_state state;
    Surroundings now;
    void *environment;
    Log log;
} Instance;

typedef struct {
    @{prefix}_state state;
    Surroundings now;
} Saved;

static void begin(Instance *instance, double time)
{
    @{prefix}_init(&instance->state);
    memset(&instance->now, 0, sizeof instance->now);
    instance->now.q.crossed_s = (double)NAN;
    instance->now.time = time;
}

static Status refuse(const Instance *instance, const char *message)
{
    if (instance->log != NULL) {
        instance->log(instance->environment, ERROR, "logStatusError", message);
    }
    return ERROR;
}

/* instances */

PUBLIC const char *fmi3GetVersion(void)
{
    return "3.0";
}

PUBLIC Status fmi3SetDebugLogging(void *instance, bool on, size_t count, const char *const categories[])
{
    return OK;
}

PUBLIC void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                         bool logging, bool events, bool early, const Reference required[],
                                         size_t required_count, void *environment, Log log, void (*update)(void))
{
    Instance *instance = NULL;

    if ((token != NULL) && (strcmp(token, TOKEN) == 0) && (events == false)) {
        instance = calloc(1, sizeof *instance);
    } else if (log != NULL) {
        log(environment, ERROR, "logStatusError", "the token is of another unit, or event mode is asked for");
    } else {
        /* nobody to tell */
    }
    if (instance != NULL) {
        instance->environment = environment;
        instance->log = log;
        begin(instance, 0.0);
    }
    return instance;
}

PUBLIC void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, bool visible,
                                          bool logging, void *environment, Log log)
{
    return NULL;
}

PUBLIC void *fmi3InstantiateScheduledExecution(const char *name, const char *token, const char *resources, bool visible,
                                               bool logging, void *environment, Log log, void (*update)(void),
                                               void (*lock)(void), void (*unlock)(void))
{
    return NULL;
}

PUBLIC void fmi3FreeInstance(void *instance)
{
    free(instance);
}

PUBLIC Status fmi3EnterInitializationMode(void *instance, bool tolerant, double tolerance, double start, bool stops,
                                          double stop)
{
    ((Instance *)instance)->now.time = start;
    return OK;
}

PUBLIC Status fmi3ExitInitializationMode(void *instance)
{
    return OK;
}

PUBLIC Status fmi3Terminate(void *instance)
{
    return OK;
}

PUBLIC Status fmi3Reset(void *instance)
{
    begin(instance, 0.0);
    return OK;
}

/* a step is a sample */

PUBLIC Status fmi3DoStep(void *handle, double time, double step, bool no_return, bool *event, bool *terminate,
                         bool *early, double *last)
{
    Instance *instance = handle;
    Surroundings *now = &instance->now;

    *event = false;
    *terminate = false;
    *early = false;
    *last = time;
    if (!(fabs(step - SAMPLE_TIME) <= STEP_TOLERANCE * SAMPLE_TIME)) {
        return refuse(instance, "a step has to be one sample time, the fixedInternalStepSize");
    }
    if (now->restart) {
        @{prefix}_restart(&instance->state);
    }
    if (@{prefix}_step(&instance->state, now->input[0], now->input[1], now->input[2], &now->q) != 0) {
        now->evaluations++;
    }
    now->time = time + step;
    *last = now->time;
    return OK;
}

/* variables */

PUBLIC Status fmi3GetFloat64(void *handle, const Reference references[], size_t count, double values[], size_t size)
{
    const Instance *instance = handle;
    double numbers[COUNT];
    size_t i;

    memcpy(numbers, &instance->now.q, sizeof numbers);
    for (i = 0; (i < count) && (i < size); i++) {
        const Reference at = references[i];

        if (at == TIME) {
            values[i] = instance->now.time;
        } else if ((at >= R) && (at <= Y)) {
            values[i] = instance->now.input[at - R];
        } else if (at == LIMIT) {
            values[i] = @{prefix}_limit;
        } else if ((at >= NUMBERS) && (at < NUMBERS + COUNT)) {
            values[i] = numbers[at - NUMBERS];
        } else {
            return refuse(instance, "no variable of type Float64 has this reference");
        }
    }
    return OK;
}

PUBLIC Status fmi3SetFloat64(void *handle, const Reference references[], size_t count, const double values[], size_t size)
{
    Instance *instance = handle;
    size_t i;

    for (i = 0; (i < count) && (i < size); i++) {
        if ((references[i] < R) || (references[i] > Y)) {
            return refuse(instance, "of type Float64, only r, u and y can be set");
        }
        instance->now.input[references[i] - R] = values[i];
    }
    return OK;
}

PUBLIC Status fmi3GetInt64(void *handle, const Reference references[], size_t count, int64_t values[], size_t size)
{
    const Instance *instance = handle;
    size_t i;

    for (i = 0; (i < count) && (i < size); i++) {
        if (references[i] != VERDICT) {
            return refuse(instance, "no enumeration has this reference");
        }
        values[i] = (int64_t)instance->now.q.verdict;
    }
    return OK;
}

PUBLIC Status fmi3GetUInt64(void *handle, const Reference references[], size_t count, uint64_t values[], size_t size)
{
    const Instance *instance = handle;
    size_t i;

    for (i = 0; (i < count) && (i < size); i++) {
        if (references[i] != EVALUATIONS) {
            return refuse(instance, "no variable of type UInt64 has this reference");
        }
        values[i] = instance->now.evaluations;
    }
    return OK;
}

PUBLIC Status fmi3GetBoolean(void *handle, const Reference references[], size_t count, bool values[], size_t size)
{
    const Instance *instance = handle;
    size_t i;

    for (i = 0; (i < count) && (i < size); i++) {
        if (references[i] != RESTART) {
            return refuse(instance, "no variable of type Boolean has this reference");
        }
        values[i] = instance->now.restart;
    }
    return OK;
}

PUBLIC Status fmi3SetBoolean(void *handle, const Reference references[], size_t count, const bool values[], size_t size)
{
    Instance *instance = handle;
    size_t i;

    for (i = 0; (i < count) && (i < size); i++) {
        if (references[i] != RESTART) {
            return refuse(instance, "of type Boolean, only restart can be set");
        }
        instance->now.restart = values[i];
    }
    return OK;
}

/* state: the image that @{prefix}_save writes, then what surrounds it, as it stands in memory */

PUBLIC Status fmi3GetFMUState(void *handle, void **copy)
{
    const Instance *instance = handle;
    Saved *saved = (*copy != NULL) ? *copy : malloc(sizeof *saved);

    if (saved == NULL) {
        return refuse(instance, "there is no memory for a copy of the state");
    }
    saved->state = instance->state;
    saved->now = instance->now;
    *copy = saved;
    return OK;
}

PUBLIC Status fmi3SetFMUState(void *handle, void *copy)
{
    Instance *instance = handle;
    const Saved *saved = copy;

    instance->state = saved->state;
    instance->now = saved->now;
    return OK;
}

PUBLIC Status fmi3FreeFMUState(void *instance, void **copy)
{
    free(*copy);
    *copy = NULL;
    return OK;
}

PUBLIC Status fmi3SerializedFMUStateSize(void *instance, void *copy, size_t *size)
{
    *size = @{upper}_IMAGE_BYTES + sizeof(Surroundings);
    return OK;
}

PUBLIC Status fmi3SerializeFMUState(void *handle, void *copy, uint8_t bytes[], size_t size)
{
    const Saved *saved = copy;

    if (size < @{upper}_IMAGE_BYTES + sizeof(Surroundings)) {
        return refuse(handle, "there is too little room for the state");
    }
    @{prefix}_save(&saved->state, bytes);
    memcpy(&bytes[@{upper}_IMAGE_BYTES], &saved->now, sizeof saved->now);
    return OK;
}

PUBLIC Status fmi3DeserializeFMUState(void *handle, const uint8_t bytes[], size_t size, void **copy)
{
    Saved *saved;

    if (size != @{upper}_IMAGE_BYTES + sizeof(Surroundings)) {
        return refuse(handle, "the bytes are no state of this unit");
    }
    saved = malloc(sizeof *saved);
    if ((saved == NULL) || (@{prefix}_load(&saved->state, bytes) == 0)) {
        free(saved);
        return refuse(handle, "the state is damaged or of another baseline");
    }
    memcpy(&saved->now, &bytes[@{upper}_IMAGE_BYTES], sizeof saved->now);
    free(*copy);
    *copy = saved;
    return OK;
}

/* what this unit has no variables, states, clocks or modes for */

#define NONE(name, ...)                                                                                                \
    PUBLIC Status name(void *instance, const Reference references[], size_t count, __VA_ARGS__)                        \
    {                                                                                                                  \
        return (count == 0u) ? OK : refuse(instance, #name ": there are no such variables");                           \
    }
#define NEVER(name, ...)                                                                                               \
    PUBLIC Status name(__VA_ARGS__)                                                                                    \
    {                                                                                                                  \
        return refuse(instance, #name ": this unit is for co-simulation without events");                              \
    }

NONE(fmi3GetFloat32, float values[], size_t size)
NONE(fmi3GetInt8, int8_t values[], size_t size)
NONE(fmi3GetUInt8, uint8_t values[], size_t size)
NONE(fmi3GetInt16, int16_t values[], size_t size)
NONE(fmi3GetUInt16, uint16_t values[], size_t size)
NONE(fmi3GetInt32, int32_t values[], size_t size)
NONE(fmi3GetUInt32, uint32_t values[], size_t size)
NONE(fmi3GetString, const char *values[], size_t size)
NONE(fmi3GetBinary, size_t sizes[], const uint8_t *values[], size_t size)
NONE(fmi3GetClock, bool values[])
NONE(fmi3SetFloat32, const float values[], size_t size)
NONE(fmi3SetInt8, const int8_t values[], size_t size)
NONE(fmi3SetUInt8, const uint8_t values[], size_t size)
NONE(fmi3SetInt16, const int16_t values[], size_t size)
NONE(fmi3SetUInt16, const uint16_t values[], size_t size)
NONE(fmi3SetInt32, const int32_t values[], size_t size)
NONE(fmi3SetUInt32, const uint32_t values[], size_t size)
NONE(fmi3SetInt64, const int64_t values[], size_t size)
NONE(fmi3SetUInt64, const uint64_t values[], size_t size)
NONE(fmi3SetString, const char *const values[], size_t size)
NONE(fmi3SetBinary, const size_t sizes[], const uint8_t *const values[], size_t size)
NONE(fmi3SetClock, const bool values[])
NONE(fmi3GetIntervalDecimal, double intervals[], int qualifiers[])
NONE(fmi3GetIntervalFraction, uint64_t counters[], uint64_t resolutions[], int qualifiers[])
NONE(fmi3GetShiftDecimal, double shifts[])
NONE(fmi3GetShiftFraction, uint64_t counters[], uint64_t resolutions[])
NONE(fmi3SetIntervalDecimal, const double intervals[])
NONE(fmi3SetIntervalFraction, const uint64_t counters[], const uint64_t resolutions[])
NONE(fmi3SetShiftDecimal, const double shifts[])
NONE(fmi3SetShiftFraction, const uint64_t counters[], const uint64_t resolutions[])
NONE(fmi3GetOutputDerivatives, const int32_t orders[], double values[], size_t size)
NONE(fmi3GetDirectionalDerivative, const Reference knowns[], size_t known_count, const double seed[], size_t seeds,
     double sensitivity[], size_t size)
NONE(fmi3GetAdjointDerivative, const Reference knowns[], size_t known_count, const double seed[], size_t seeds,
     double sensitivity[], size_t size)
NEVER(fmi3GetNumberOfVariableDependencies, void *instance, Reference reference, size_t *count)
NEVER(fmi3GetVariableDependencies, void *instance, Reference dependent, size_t elements[], Reference independents[],
      size_t of_independents[], int kinds[], size_t count)
NEVER(fmi3EnterEventMode, void *instance)
NEVER(fmi3EnterStepMode, void *instance)
NEVER(fmi3EnterConfigurationMode, void *instance)
NEVER(fmi3ExitConfigurationMode, void *instance)
NEVER(fmi3EvaluateDiscreteStates, void *instance)
NEVER(fmi3UpdateDiscreteStates, void *instance, bool *need, bool *terminate, bool *nominals, bool *values, bool *defined,
      double *next)
NEVER(fmi3EnterContinuousTimeMode, void *instance)
NEVER(fmi3CompletedIntegratorStep, void *instance, bool no_return, bool *event, bool *terminate)
NEVER(fmi3SetTime, void *instance, double time)
NEVER(fmi3SetContinuousStates, void *instance, const double states[], size_t count)
NEVER(fmi3GetContinuousStateDerivatives, void *instance, double derivatives[], size_t count)
NEVER(fmi3GetEventIndicators, void *instance, double indicators[], size_t count)
NEVER(fmi3GetContinuousStates, void *instance, double states[], size_t count)
NEVER(fmi3GetNominalsOfContinuousStates, void *instance, double nominals[], size_t count)
NEVER(fmi3GetNumberOfEventIndicators, void *instance, size_t *count)
NEVER(fmi3GetNumberOfContinuousStates, void *instance, size_t *count)
NEVER(fmi3ActivateModelPartition, void *instance, Reference clock, double time)
