/* Rollouts of a compiled model.

   Compiled once for models of the sizes NX, NU and NY, below vector_math.c, rollout.h and what
   fallback.py says of STATE_LIMIT and of steps, and linked to each model's own code. A vector holds
   one rollout in its first lane: the code is that of many rollouts, and with what is prepared and
   its short elementary functions faster than C for one.

   Rows k = 0 .. n-1 are instants; the input of row k is held until row k+1, dt[k] later. */

#include <math.h>
#include <string.h>

static int steps_of(double dt, double largest)
{
    int n = (int)ceil(dt / largest * (1 - 1e-9));
    return n < 1 ? 1 : n;
}

static int sane(const double *x)
{
    for (int i = 0; i < NX; i++)
        if (!(fabs(x[i]) < STATE_LIMIT)) return 0;
    return 1;
}

/* One Runge-Kutta step from x to y, and the slope of its last stage. */
static void step(const vd *x, const vd *u, const vd *s, double h, vd *y, vd *k4)
{
    vd k1[NX], k2[NX], k3[NX];
    rates(x, u, s, k1);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h / 2 * k1[i];
    rates(y, u, s, k2);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h / 2 * k2[i];
    rates(y, u, s, k3);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h * k3[i];
    rates(y, u, s, k4);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h / 6 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
}

static void splat(int n, const double *from, vd *to)
{
    for (int i = 0; i < n; i++) to[i] = SPLAT(from[i]);
}

static void first_lane(int n, const vd *from, double *to)
{
    for (int i = 0; i < n; i++) to[i] = from[i][0];
}

static void prepared(const double *p, vd *s)
{
    vd parameters[parameter_count];
    splat(parameter_count, p, parameters);
    prepare(parameters, s);
}

/* n Runge-Kutta steps of h seconds, in place. */
void cgm_advance(double *state, const double *input, const double *p, double h, int n)
{
    vd s[shared + 1], x[NX], u[NU], y[NX], k4[NX];
    prepared(p, s);
    splat(NX, state, x), splat(NU, input, u);
    for (int i = 0; i < n; i++) {
        step(x, u, s, h, y, k4);
        memcpy(x, y, sizeof y);
    }
    first_lane(NX, x, state);
}

/* Error of a step of h from x to y with the last stage's slope k4, in tolerances: how far from it
   the solution of third order is that has the slope at y in place of k4. */
static double error_of(const vd *x, const vd *y, const vd *k4, const vd *u, const vd *s, double h,
                       double tolerance)
{
    vd k5[NX];
    double error = 0;
    rates(y, u, s, k5);
    for (int i = 0; i < NX; i++) {
        const double size = fabs(x[i][0]), unit = state_scale[i] * (size > 1 ? size : 1);
        const double own = fabs(h / 6 * (k4[i][0] - k5[i][0])) / unit;
        /* What is no number is no error: the state has run away, which is found after the step. */
        error = own > error ? own : error;
    }
    return error / tolerance;
}

/* How far a row's interval is cut: steps are halved where they err, as where teeth meet or
   friction turns, and doubled where they are easy. */
typedef struct {
    const int halvings; /* at most */
    int halved; /* times, from row to row */
    int done;   /* smallest steps of this interval */
    unsigned steps; /* a bit for each smallest step at which one of this interval began */
} Pace;

static const int WHOLE = 1 << HALVINGS;

/* Whether a step of this error stands; sets the pace of the next one. */
static int stands(Pace *pace, double error)
{
    const int length = WHOLE >> pace->halved;
    if (error > 1 && pace->halved < pace->halvings) {
        pace->halved++;
        return 0;
    }
    pace->steps |= 1u << pace->done;
    pace->done += length;
    if (error < EASY && pace->halved > 0 && pace->done % (2 * length) == 0) pace->halved--;
    return 1;
}

/* h seconds from x, in place. */
static void follow(vd *x, const vd *u, const vd *s, double h, double tolerance, Pace *pace)
{
    vd y[NX], k4[NX];
    pace->steps = 0;
    for (pace->done = 0; pace->done < WHOLE;) {
        const double part = h / (1 << pace->halved);
        step(x, u, s, part, y, k4);
        if (stands(pace, error_of(x, y, k4, u, s, part, tolerance))) memcpy(x, y, sizeof y);
    }
}

/* States at all rows, X (n, NX), and the steps that led there (Pace), steps (n, most) if not null,
   where no row takes more than `most` intervals, cut in half at most `halvings` times. Returns the
   number of rows before the state ran away. */
int cgm_simulate(int n, const double *dt, double largest, double tolerance, int halvings,
                 const double *inputs, const double *x0, const double *p, double *X, int most,
                 int *steps)
{
    Pace pace = {.halvings = halvings};
    vd s[shared + 1], x[NX], u[NU];
    prepared(p, s);
    splat(NX, x0, x);
    memcpy(X, x0, NX * sizeof(double));
    for (int k = 0; k + 1 < n; k++) {
        const int m = steps_of(dt[k], largest);
        splat(NU, inputs + k * NU, u);
        for (int i = 0; i < m; i++) {
            follow(x, u, s, dt[k] / m, tolerance, &pace);
            if (steps && i < most) steps[k * most + i] = (int)pace.steps;
        }
        first_lane(NX, x, X + (k + 1) * NX);
        if (!sane(X + (k + 1) * NX)) return k + 1;
    }
    return n;
}

static int before(int k, double t, const double *time)
{
    while (k > 0 && time[k] > t) k--;
    return k;
}

/* `past` seconds after x0: cubic Hermite to x1, h later; straight on where x1 is null. */
static void interpolate(double h, double past, const vd *x0, const vd *d0, const vd *x1,
                        const vd *d1, vd *x)
{
    if (!x1) {
        for (int i = 0; i < NX; i++) x[i] = x0[i] + past * d0[i];
        return;
    }
    double s = past / h, r = 1 - s;
    double a0 = (1 + 2 * s) * r * r, a1 = (1 + 2 * r) * s * s;
    double b0 = h * s * r * r, b1 = -h * r * s * s;
    for (int i = 0; i < NX; i++) x[i] = a0 * x0[i] + a1 * x1[i] + b0 * d0[i] + b1 * d1[i];
}

/* Outputs (n, NY) of given states, each late by delay[NY] seconds. */
void cgm_outputs(int n, const double *time, const double *inputs, const double *p, const double *X,
                 const double *delay, double *Y)
{
    vd s[shared + 1], u[NU], y[NY], x[NX], x0[NX], x1[NX], d0[NX], d1[NX];
    prepared(p, s);
    for (int k = 0; k < n; k++) {
        splat(NX, X + k * NX, x), splat(NU, inputs + k * NU, u);
        outputs(x, u, s, y);
        first_lane(NY, y, Y + k * NY);
        for (int j = 0; j < NY; j++) {
            if (delay[j] <= 0) continue;
            const double t = time[k] - delay[j];
            const int b = before(k, t, time), on = b + 1 < n && t > time[0];
            /* The input of row b is held up to row b+1, so it gives the slope there too. */
            splat(NU, inputs + b * NU, u), splat(NX, X + b * NX, x0);
            rates(x0, u, s, d0);
            if (on) splat(NX, X + (b + 1) * NX, x1), rates(x1, u, s, d1);
            interpolate(on ? time[b + 1] - time[b] : 0, t - time[b], x0, d0, on ? x1 : 0, d1, x);
            outputs(x, u, s, y);
            Y[k * NY + j] = y[j][0];
        }
    }
}
