/* The engineer's twin of the motor as an FMI 2.0 FMU, for co-simulation and for model exchange:
 *     angle' = speed,   speed' = (speed_per_V command - speed) / time_constant_s.
 * Co-simulation holds the command over a step and is exact then. Only what a real-valued model needs is here. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { COMMAND, ANGLE, SPEED, RATE_ANGLE, RATE_SPEED, SPEED_PER_V, TIME_CONSTANT, COUNT };
typedef struct { double v[COUNT]; } Model;
typedef struct { int discrete, terminate, nominals, states, defined; double next; } EventInfo;

static void start(Model *m) {
    memset(m, 0, sizeof *m);
    m->v[SPEED_PER_V] = 20.0;
    m->v[TIME_CONSTANT] = 0.08;
}

static void rates(Model *m) {
    m->v[RATE_ANGLE] = m->v[SPEED];
    m->v[RATE_SPEED] = (m->v[SPEED_PER_V] * m->v[COMMAND] - m->v[SPEED]) / m->v[TIME_CONSTANT];
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

void *fmi2Instantiate(const char *name, int kind, const char *guid, const char *at, const void *functions, int visible,
                      int logging) {
    Model *m = malloc(sizeof *m);
    (void)name, (void)kind, (void)guid, (void)at, (void)functions, (void)visible, (void)logging;
    if (m) start(m);
    return m;
}
void fmi2FreeInstance(void *m) { free(m); }
int fmi2Reset(void *m) { start(m); return 0; }
int fmi2SetupExperiment(void *m, int a, double b, double c, int d, double e) {
    (void)m, (void)a, (void)b, (void)c, (void)d, (void)e;
    return 0;
}
int fmi2SetDebugLogging(void *m, int a, size_t n, const char *const *c) { (void)m, (void)a, (void)n, (void)c; return 0; }
int fmi2EnterInitializationMode(void *m) { (void)m; return 0; }
int fmi2ExitInitializationMode(void *m) { (void)m; return 0; }
int fmi2Terminate(void *m) { (void)m; return 0; }

int fmi2GetReal(void *c, const unsigned *r, size_t n, double *v) {
    Model *m = c;
    rates(m);
    for (size_t i = 0; i < n; i++) {
        if (r[i] >= COUNT) return 3;
        v[i] = m->v[r[i]];
    }
    return 0;
}
int fmi2SetReal(void *c, const unsigned *r, size_t n, const double *v) {
    for (size_t i = 0; i < n; i++) {
        if (r[i] >= COUNT) return 3;
        ((Model *)c)->v[r[i]] = v[i];
    }
    return 0;
}

/* integers, booleans and strings: there are none */
#define NONE(NAME, TYPE) \
    int NAME(void *c, const unsigned *r, size_t n, TYPE v) { (void)c, (void)r, (void)v; return n ? 3 : 0; }
NONE(fmi2GetInteger, int *)
NONE(fmi2GetBoolean, int *)
NONE(fmi2GetString, const char **)
NONE(fmi2SetInteger, const int *)
NONE(fmi2SetBoolean, const int *)
NONE(fmi2SetString, const char *const *)

int fmi2DoStep(void *c, double t, double h, int keep) {
    Model *m = c;
    double tau = m->v[TIME_CONSTANT], decay = exp(-h / tau), end = m->v[SPEED_PER_V] * m->v[COMMAND];
    (void)t, (void)keep;
    m->v[ANGLE] += end * h + (m->v[SPEED] - end) * tau * (1.0 - decay);
    m->v[SPEED] = end + (m->v[SPEED] - end) * decay;
    return 0;
}

/* model exchange */
int fmi2SetTime(void *c, double t) { (void)c, (void)t; return 0; }
int fmi2SetContinuousStates(void *c, const double *x, size_t n) { memcpy(((Model *)c)->v + ANGLE, x, n * sizeof *x); return 0; }
int fmi2GetContinuousStates(void *c, double *x, size_t n) { memcpy(x, ((Model *)c)->v + ANGLE, n * sizeof *x); return 0; }
int fmi2GetDerivatives(void *c, double *x, size_t n) {
    rates(c);
    memcpy(x, ((Model *)c)->v + RATE_ANGLE, n * sizeof *x);
    return 0;
}
int fmi2GetNominalsOfContinuousStates(void *c, double *x, size_t n) {
    (void)c;
    for (size_t i = 0; i < n; i++) x[i] = 1.0;
    return 0;
}
int fmi2GetEventIndicators(void *c, double *z, size_t n) { (void)c, (void)z, (void)n; return 0; }
int fmi2EnterEventMode(void *c) { (void)c; return 0; }
int fmi2EnterContinuousTimeMode(void *c) { (void)c; return 0; }
int fmi2NewDiscreteStates(void *c, EventInfo *e) { (void)c; memset(e, 0, sizeof *e); return 0; }
int fmi2CompletedIntegratorStep(void *c, int keep, int *event, int *stop) {
    (void)c, (void)keep;
    *event = *stop = 0;
    return 0;
}

/* what this model does not offer, as its description says */
#define MISSING(NAME) int NAME(void *c) { (void)c; return 3; }
MISSING(fmi2GetFMUstate)
MISSING(fmi2SetFMUstate)
MISSING(fmi2FreeFMUstate)
MISSING(fmi2SerializedFMUstateSize)
MISSING(fmi2SerializeFMUstate)
MISSING(fmi2DeSerializeFMUstate)
MISSING(fmi2GetDirectionalDerivative)
MISSING(fmi2SetRealInputDerivatives)
MISSING(fmi2GetRealOutputDerivatives)
MISSING(fmi2CancelStep)
MISSING(fmi2GetStatus)
MISSING(fmi2GetRealStatus)
MISSING(fmi2GetIntegerStatus)
MISSING(fmi2GetBooleanStatus)
MISSING(fmi2GetStringStatus)
