/* Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0 */
/* A heated rod of N segments as an FMU of FMI 2.0 and 3.0, for model exchange and co-simulation:

       T_i' = k (T_{i-1} - 2 T_i + T_{i+1}) - loss T_i + power q,     insulated ends

   Value references: 0 the time, 1 the input q, 2 k, 3 T0, 4 .. T_1 .. T_N, then their derivatives. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#define N 20
#define STEPS 40
typedef struct { double time, q, k, T0, T[N]; int begun; } Rod;
static double value(Rod *rod, unsigned r, double dT[]) {
    return r == 0 ? rod->time : r == 1 ? rod->q : r == 2 ? rod->k : r == 3 ? rod->T0
         : r < 4 + N ? (rod->begun ? rod->T[r - 4] : rod->T0) : dT[r - 4 - N];
}
static void derivatives(Rod *rod, double dT[]) {
    for (int i = 0; i < N; i++) {
        double T = rod->T[i], left = rod->T[i ? i - 1 : 0], right = rod->T[i < N - 1 ? i + 1 : i];
        dT[i] = rod->k * (left - 2 * T + right) - 0.1 * T + 0.5 * rod->q;
    }
}
static void start(Rod *rod) { *rod = (Rod){.k = 4.0, .T0 = 1.0}; }
static int begin(Rod *rod) {
#if FMI == 2
    if (rod->begun && RESET < 0) return 0; /* it was not reset as a whole */
#endif
    rod->begun = 1;
    for (int i = 0; i < N; i++) rod->T[i] = rod->T0;
    return 0;
}
static int get(Rod *rod, const unsigned refs[], size_t n, double values[]) {
    double dT[N];
    derivatives(rod, dT);
    for (size_t i = 0; i < n; i++) values[i] = value(rod, refs[i], dT);
    return 0;
}
static int set(Rod *rod, const unsigned refs[], size_t n, const double values[]) {
    for (size_t i = 0; i < n; i++) {
        if (refs[i] < 1 || refs[i] > 3) return 3;
        (&rod->time)[refs[i]] = values[i];
    }
    return 0;
}
static int advance(Rod *rod, double h) {
    double dT[N];
    if (rod->q > 1e6) return 2; /* it melts: discarded */
    for (int s = 0; s < STEPS; s++) {
        derivatives(rod, dT);
        for (int i = 0; i < N; i++) rod->T[i] += h / STEPS * dT[i];
    }
    rod->time += h;
    return 0;
}
static void *made(void) { Rod *rod = malloc(sizeof(Rod)); start(rod); return rod; }
static int keep(Rod *rod, void **state) {
    if (!*state) *state = malloc(sizeof(Rod));
    memcpy(*state, rod, sizeof(Rod));
    return 0;
}
static int loosen(void **state) { free(*state); *state = NULL; return 0; }
static int copy(double to[], const double from[], size_t n) { memcpy(to, from, n * sizeof(double)); return 0; }
static int ones(double x[], size_t n) { for (size_t i = 0; i < n; i++) x[i] = 1.0; return 0; }
static int rates(Rod *rod, double dT[]) { derivatives(rod, dT); return 0; }
#define OK(name) int name(void) { return 0; }
#define NONE(name) int name(void) { return 3; }
#if FMI == 2
typedef struct { int needed, ended, nominals, values, defined; double next; } Event;
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
void *fmi2Instantiate(void) { return made(); }
void fmi2FreeInstance(Rod *rod) { free(rod); }
int fmi2Reset(Rod *rod) { if (!RESET) start(rod); return RESET > 0 ? RESET : 0; }
int fmi2ExitInitializationMode(Rod *rod) { return begin(rod); }
int fmi2GetReal(Rod *rod, const unsigned r[], size_t n, double v[]) { return get(rod, r, n, v); }
int fmi2SetReal(Rod *rod, const unsigned r[], size_t n, const double v[]) { return set(rod, r, n, v); }
int fmi2DoStep(Rod *rod, double t, double h, int a) { (void)t; (void)a; return advance(rod, h); }
int fmi2NewDiscreteStates(Rod *rod, Event *e) { (void)rod; *e = (Event){0}; return 0; }
int fmi2CompletedIntegratorStep(Rod *rod, int a, int *event, int *ended) {
    (void)rod; (void)a; *event = *ended = 0; return 0;
}
int fmi2SetTime(Rod *rod, double t) { rod->time = t; return 0; }
int fmi2GetContinuousStates(Rod *rod, double x[], size_t n) { return copy(x, rod->T, n); }
int fmi2SetContinuousStates(Rod *rod, const double x[], size_t n) { return copy(rod->T, x, n); }
int fmi2GetDerivatives(Rod *rod, double dx[], size_t n) { (void)n; return rates(rod, dx); }
int fmi2GetNominalsOfContinuousStates(Rod *rod, double x[], size_t n) { (void)rod; return ones(x, n); }
int fmi2GetFMUstate(Rod *rod, void **s) { return keep(rod, s); }
int fmi2SetFMUstate(Rod *rod, void *s) { memcpy(rod, s, sizeof(Rod)); return 0; }
int fmi2FreeFMUstate(Rod *rod, void **s) { (void)rod; return loosen(s); }
OK(fmi2SetDebugLogging) OK(fmi2SetupExperiment) OK(fmi2EnterInitializationMode) OK(fmi2Terminate)
OK(fmi2EnterEventMode) OK(fmi2EnterContinuousTimeMode) OK(fmi2GetEventIndicators)
NONE(fmi2GetInteger) NONE(fmi2GetBoolean) NONE(fmi2GetString) NONE(fmi2SetInteger) NONE(fmi2SetBoolean)
NONE(fmi2SetString) NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate)
NONE(fmi2DeSerializeFMUstate) NONE(fmi2GetDirectionalDerivative) NONE(fmi2SetRealInputDerivatives)
NONE(fmi2GetRealOutputDerivatives) NONE(fmi2CancelStep) NONE(fmi2GetStatus) NONE(fmi2GetRealStatus)
NONE(fmi2GetIntegerStatus) NONE(fmi2GetBooleanStatus) NONE(fmi2GetStringStatus)
#else
#include <stdbool.h>
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateCoSimulation(void) { return made(); }
void *fmi3InstantiateModelExchange(void) { return made(); }
void fmi3FreeInstance(Rod *rod) { free(rod); }
int fmi3Reset(Rod *rod) { start(rod); return 0; }
int fmi3ExitInitializationMode(Rod *rod) { return begin(rod); }
int fmi3GetFloat64(Rod *rod, const unsigned r[], size_t n, double v[], size_t m) {
    unsigned every[N];
    if (n != 1 || r[0] < 4) return get(rod, r, n, v);
    for (unsigned i = 0; i < N; i++) every[i] = r[0] + i; /* an array */
    return get(rod, every, m, v);
}
int fmi3SetFloat64(Rod *rod, const unsigned r[], size_t n, const double v[], size_t m) {
    (void)m; return set(rod, r, n, v);
}
int fmi3DoStep(Rod *rod, double t, double h, bool a, bool *event, bool *ended, bool *early, double *last) {
    int status = advance(rod, h);
    (void)a; *event = *ended = *early = false; *last = t + h;
    return status;
}
int fmi3UpdateDiscreteStates(Rod *rod, bool *a, bool *b, bool *c, bool *d, bool *e, double *next) {
    (void)rod; *a = *b = *c = *d = *e = false; *next = 0.0; return 0;
}
int fmi3CompletedIntegratorStep(Rod *rod, bool a, bool *event, bool *ended) {
    (void)rod; (void)a; *event = *ended = false; return 0;
}
int fmi3SetTime(Rod *rod, double t) { rod->time = t; return 0; }
int fmi3GetContinuousStates(Rod *rod, double x[], size_t n) { return copy(x, rod->T, n); }
int fmi3SetContinuousStates(Rod *rod, const double x[], size_t n) { return copy(rod->T, x, n); }
int fmi3GetContinuousStateDerivatives(Rod *rod, double dx[], size_t n) { (void)n; return rates(rod, dx); }
int fmi3GetNominalsOfContinuousStates(Rod *rod, double x[], size_t n) { (void)rod; return ones(x, n); }
int fmi3GetFMUState(Rod *rod, void **s) { return keep(rod, s); }
int fmi3SetFMUState(Rod *rod, void *s) { memcpy(rod, s, sizeof(Rod)); return 0; }
int fmi3FreeFMUState(Rod *rod, void **s) { (void)rod; return loosen(s); }
OK(fmi3SetDebugLogging) OK(fmi3EnterInitializationMode) OK(fmi3Terminate) OK(fmi3EnterEventMode)
OK(fmi3EnterContinuousTimeMode) OK(fmi3GetEventIndicators) OK(fmi3EnterStepMode)
#define EACH(kind) NONE(fmi3Get##kind) NONE(fmi3Set##kind)
EACH(Float32) EACH(Int8) EACH(UInt8) EACH(Int16) EACH(UInt16) EACH(Int32) EACH(UInt32) EACH(Int64)
EACH(UInt64) EACH(Boolean) EACH(String) EACH(Binary) EACH(Clock) EACH(IntervalDecimal)
EACH(IntervalFraction) EACH(ShiftDecimal) EACH(ShiftFraction)
NONE(fmi3InstantiateScheduledExecution) NONE(fmi3GetNumberOfVariableDependencies)
NONE(fmi3GetVariableDependencies) NONE(fmi3SerializedFMUStateSize) NONE(fmi3SerializeFMUState)
NONE(fmi3DeserializeFMUState) NONE(fmi3GetDirectionalDerivative) NONE(fmi3GetAdjointDerivative)
NONE(fmi3EnterConfigurationMode) NONE(fmi3ExitConfigurationMode) NONE(fmi3EvaluateDiscreteStates)
NONE(fmi3GetNumberOfEventIndicators) NONE(fmi3GetNumberOfContinuousStates)
NONE(fmi3GetOutputDerivatives) NONE(fmi3ActivateModelPartition)
#endif
