/* Rollouts of one compiled model, with forward sensitivities.

   Linked with the code that CasADi generates for that model, which defines
     cgm_f (x, u, p) -> dx/dt              cgm_fs -> dx/dt, d/dx, d/du, d/dfree   (row-major)
     cgm_h (x, u, p) -> y                  cgm_hs -> y, d/dx, d/dfree             (row-major)
   Given are the sizes NX, NU, NP, NF (free parameters), NY, W (work space of the functions) and
   MAX_COLUMNS, the SCALES of the states, and what fallback.py says of STATE_LIMIT and of steps.

   Rows k = 0 .. n-1 are instants; the input of row k is held until row k+1, dt[k] later. A
   sensitivity matrix S has NX rows and nc columns: first the initial state or whatever S0 says,
   anywhere the free parameters, placed by column[NF] (-1: held constant). */

#include <math.h>
#include <string.h>

int cgm_f(const double **arg, double **res, long long *iw, double *w, int mem);
int cgm_fs(const double **arg, double **res, long long *iw, double *w, int mem);
int cgm_h(const double **arg, double **res, long long *iw, double *w, int mem);
int cgm_hs(const double **arg, double **res, long long *iw, double *w, int mem);

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

static void rates(const double *x, const double *u, const double *p, double *dx)
{
    const double *arg[3] = {x, u, p};
    double *res[1] = {dx}, w[W];
    cgm_f(arg, res, 0, w, 0);
}

/* One Runge-Kutta step from x to y, and the slope of its last stage. */
static void step(const double *x, const double *u, const double *p, double h, double *y, double *k4)
{
    double k1[NX], k2[NX], k3[NX];
    rates(x, u, p, k1);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h / 2 * k1[i];
    rates(y, u, p, k2);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h / 2 * k2[i];
    rates(y, u, p, k3);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h * k3[i];
    rates(y, u, p, k4);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
}

/* n Runge-Kutta steps of h seconds, in place. */
void cgm_advance(double *x, const double *u, const double *p, double h, int n)
{
    double y[NX], k4[NX];
    for (int i = 0; i < n; i++) {
        step(x, u, p, h, y, k4);
        memcpy(x, y, sizeof y);
    }
}

/* Error of a step of h from x to y with the last stage's slope k4, in tolerances: how far from it
   the solution of third order is that has the slope at y in place of k4. */
static double error_of(const double *x, const double *y, const double *k4, const double *u,
                       const double *p, double h, double tolerance)
{
    static const double scale[NX] = SCALES;
    double k5[NX], error = 0;
    rates(y, u, p, k5);
    for (int i = 0; i < NX; i++)
        error = fmax(error, fabs(h / 6 * (k4[i] - k5[i])) / (scale[i] * fmax(1, fabs(x[i]))));
    return error / tolerance;
}

/* How far a row's interval is cut: steps are halved where they err, as where teeth meet or
   friction turns, and doubled where they are easy. */
typedef struct {
    int halved; /* times, from row to row */
    int done;   /* smallest steps of this interval */
} Pace;

static const int WHOLE = 1 << HALVINGS;

/* Whether a step of this error stands; sets the pace of the next one. */
static int stands(Pace *pace, double error)
{
    const int length = WHOLE >> pace->halved;
    if (error > 1 && pace->halved < HALVINGS) {
        pace->halved++;
        return 0;
    }
    pace->done += length;
    if (error < EASY && pace->halved > 0 && pace->done % (2 * length) == 0) pace->halved--;
    return 1;
}

/* h seconds from x, in place. */
static void follow(double *x, const double *u, const double *p, double h, double tolerance,
                   Pace *pace)
{
    double y[NX], k4[NX];
    for (pace->done = 0; pace->done < WHOLE;) {
        const double part = h / (1 << pace->halved);
        step(x, u, p, part, y, k4);
        if (stands(pace, error_of(x, y, k4, u, p, part, tolerance))) memcpy(x, y, sizeof y);
    }
}

/* States at all rows, X (n, NX). Returns the number of rows before the state ran away. */
int cgm_simulate(int n, const double *dt, double largest, double tolerance, const double *u,
                 const double *x0, const double *p, double *X)
{
    Pace pace = {0};
    memcpy(X, x0, NX * sizeof(double));
    for (int k = 0; k + 1 < n; k++) {
        double *x = X + (k + 1) * NX;
        int m = steps_of(dt[k], largest);
        memcpy(x, x - NX, NX * sizeof(double));
        for (int i = 0; i < m; i++)
            follow(x, u + k * NU, p, dt[k] / m, tolerance, &pace);
        if (!sane(x)) return k + 1;
    }
    return n;
}

static int before(int k, double t, const double *time)
{
    while (k > 0 && time[k] > t) k--;
    return k;
}

static void interpolate(int width, double h, double past, const double *x0, const double *d0,
                        const double *x1, const double *d1, double *out)
{
    /* `past` seconds after x0: cubic Hermite to x1, h later; straight on where x1 is null. */
    if (!x1) {
        for (int i = 0; i < width; i++) out[i] = x0[i] + past * d0[i];
        return;
    }
    double s = past / h, r = 1 - s;
    double a0 = (1 + 2 * s) * r * r, a1 = (1 + 2 * r) * s * s;
    double b0 = h * s * r * r, b1 = -h * r * s * s;
    for (int i = 0; i < width; i++) out[i] = a0 * x0[i] + a1 * x1[i] + b0 * d0[i] + b1 * d1[i];
}

/* Outputs (n, NY) of given states, each late by delay[NY] seconds; NaN for what a late sensor
   saw before the first row, which nobody simulated. */
void cgm_outputs(int n, const double *time, const double *u, const double *p, const double *X,
                 const double *delay, double *Y)
{
    double late = 0, w[W], y[NY], x[NX], d[2 * NX];
    for (int j = 0; j < NY; j++) late = fmax(late, delay[j]);
    for (int k = 0; k < n; k++) {
        const double *arg[3] = {X + k * NX, u + k * NU, p};
        double *res[1] = {y};
        cgm_h(arg, res, 0, w, 0);
        memcpy(Y + k * NY, y, NY * sizeof(double));
        if (late <= 0) continue;
        for (int j = 0; j < NY; j++) {
            if (delay[j] <= 0) continue;
            double t = time[k] - delay[j];
            int b = before(k, t, time);
            /* The input of row b is held up to row b+1, so it gives the slope there too. */
            const double *x0 = X + b * NX, *x1 = b + 1 < n && t > time[0] ? x0 + NX : 0;
            rates(x0, u + b * NU, p, d);
            if (x1) rates(x1, u + b * NU, p, d + NX);
            interpolate(NX, x1 ? time[b + 1] - time[b] : 0, t - time[b], x0, d, x1, d + NX, x);
            const double *late_arg[3] = {x, u + b * NU, p};
            cgm_h(late_arg, res, 0, w, 0);
            Y[k * NY + j] = y[j];
        }
    }
}

/* dx = f and dS = A S + P, with du/d(delay) feeding column delay_column. Returns how fast the sum
   of all modes decays, -trace A: dry friction or bristles may settle faster than a step. */
static double variational(const double *x, const double *S, const double *u, const double *du,
                        int delay_column, const double *p, int nc, const int *column, double *dx,
                        double *dS)
{
    double A[NX * NX], B[NX * NU], P[NX * NF + 1], w[W], decay = 0;
    const double *arg[3] = {x, u, p};
    double *res[4] = {dx, A, B, P};
    cgm_fs(arg, res, 0, w, 0);
    for (int i = 0; i < NX; i++) {
        double *row = dS + i * nc;
        for (int c = 0; c < nc; c++) row[c] = 0;
        for (int j = 0; j < NX; j++) {
            const double a = A[i * NX + j], *s = S + j * nc;
            if (a != 0)
                for (int c = 0; c < nc; c++) row[c] += a * s[c];
        }
        for (int f = 0; f < NF; f++)
            if (column[f] >= 0) row[column[f]] += P[i * NF + f];
        if (delay_column >= 0)
            for (int j = 0; j < NU; j++) row[delay_column] += B[i * NU + j] * du[j];
        decay -= A[i * NX + i];
    }
    return decay;
}

/* `follow` with the variational equations, over the same steps. */
static void follow_sensitive(double *x, double *S, const double *u, const double *du,
                             int delay_column, const double *p, int nc, const int *column,
                             double h, double tolerance, Pace *pace)
{
    double k1[NX], k2[NX], k3[NX], k4[NX], y[NX];
    double s1[NX * MAX_COLUMNS], s2[NX * MAX_COLUMNS], s3[NX * MAX_COLUMNS], s4[NX * MAX_COLUMNS],
        T[NX * MAX_COLUMNS];
    const int ns = NX * nc;
#define STAGE(K, SK, FACTOR, KN, SN)                                                             \
    for (int i = 0; i < NX; i++) y[i] = x[i] + (FACTOR) * K[i];                                   \
    for (int i = 0; i < ns; i++) T[i] = S[i] + (FACTOR) * SK[i];                                  \
    variational(y, T, u, du, delay_column, p, nc, column, KN, SN);
    for (pace->done = 0; pace->done < WHOLE;) {
        const double part = h / (1 << pace->halved);
        const double decay = variational(x, S, u, du, delay_column, p, nc, column, k1, s1);
        /* A state may rest where its sensitivity would already be unstable. */
        if (part * decay > STABLE && pace->halved < HALVINGS) {
            pace->halved++;
            continue;
        }
        STAGE(k1, s1, part / 2, k2, s2)
        STAGE(k2, s2, part / 2, k3, s3)
        STAGE(k3, s3, part, k4, s4)
        for (int i = 0; i < NX; i++)
            y[i] = x[i] + part / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
        if (!stands(pace, error_of(x, y, k4, u, p, part, tolerance))) continue;
        memcpy(x, y, sizeof y);
        for (int i = 0; i < ns; i++) S[i] += part / 6 * (s1[i] + 2 * s2[i] + 2 * s3[i] + s4[i]);
    }
}

/* y and its rows of the Jacobian, J (NY, nc), at one state. */
static void output_sensitive(const double *x, const double *S, const double *u, const double *p,
                             int nc, const int *column, double *y, double *J)
{
    double C[NY * NX], D[NY * NF + 1], w[W];
    const double *arg[3] = {x, u, p};
    double *res[3] = {y, C, D};
    cgm_hs(arg, res, 0, w, 0);
    for (int j = 0; j < NY; j++) {
        double *row = J + j * nc;
        for (int c = 0; c < nc; c++) row[c] = 0;
        for (int i = 0; i < NX; i++)
            if (C[j * NX + i] != 0)
                for (int c = 0; c < nc; c++) row[c] += C[j * NX + i] * S[i * nc + c];
        for (int f = 0; f < NF; f++)
            if (column[f] >= 0) row[column[f]] += D[j * NF + f];
    }
}

/* Normal equations of the simulation error (4.13) over rows 0 .. n-1:

     H (nc, nc) += sum_kj w_j^2 J'J,  g (nc) += sum_kj w_j^2 J' r,  r = y_sim - y_measured
     sse (NY) += sum_k w_j^2 r^2,     count (NY) += samples;  NaN marks a sample that is not there

   delay (NY) in s and delay_to (NY), the column of each output's delay or -1. history is work
   space for n rows of (x, dx/dt, S, dS/dt), needed only where some delay is positive or free.
   Jacobian (n, NY, nc) and Y (n, NY) are filled if not null.
   Returns the number of rows before the state ran away. */
int cgm_normal(int n, const double *time, double largest, double tolerance, const double *u,
               const double *du, int delay_column, const double *x0, const double *S0,
               const double *p, int nc,
               const int *column, const double *measured, const double *weight,
               const double *delay, const int *delay_to, double *history, double *H, double *g,
               double *sse, double *count, double *Y, double *Jacobian)
{
    double x[NX], S[NX * MAX_COLUMNS], k1[NX], s1[NX * MAX_COLUMNS], k0[NX],
        s0[NX * MAX_COLUMNS], y[NY], J[NY * MAX_COLUMNS], late_x[2 * NX],
        late_S[2 * NX * MAX_COLUMNS], late_y[NY], late_J[NY * MAX_COLUMNS];
    const int ns = NX * nc;
    double *hx = history, *hd = hx + (size_t)n * NX, *hS = hd + (size_t)n * NX,
           *hD = hS + (size_t)n * ns;
    Pace pace = {0};
    int any_late = 0;
    for (int j = 0; j < NY; j++) any_late |= delay[j] > 0 || delay_to[j] >= 0;
    memcpy(x, x0, sizeof x);
    memcpy(S, S0, ns * sizeof(double));
    for (int k = 0; k < n; k++) {
        const double *uk = u + k * NU, *duk = du + k * NU;
        if (any_late) {
            variational(x, S, uk, duk, delay_column, p, nc, column, k0, s0);
            memcpy(hx + (size_t)k * NX, x, sizeof x);
            memcpy(hd + (size_t)k * NX, k0, sizeof k0);
            memcpy(hS + (size_t)k * ns, S, ns * sizeof(double));
            memcpy(hD + (size_t)k * ns, s0, ns * sizeof(double));
        }
        output_sensitive(x, S, uk, p, nc, column, y, J);
        for (int j = 0; any_late && j < NY; j++) {
            if (delay[j] <= 0 && delay_to[j] < 0) continue;
            double t = time[k] - delay[j], slope = 0;
            int b = before(k, t, time);
            double *x0 = hx + (size_t)b * NX, *x1 = b < k && t > time[0] ? x0 + NX : 0;
            double *d0 = hd + (size_t)b * NX, *S0b = hS + (size_t)b * ns, *D0 = hD + (size_t)b * ns;
            double h = x1 ? time[b + 1] - time[b] : 0;
            /* The input of row b is held up to row b+1, so it gives the slope there too. */
            if (x1)
                variational(x1, S0b + ns, u + b * NU, du + b * NU, delay_column, p, nc, column, k1,
                            s1);
            interpolate(NX, h, t - time[b], x0, d0, x1, k1, late_x);
            interpolate(ns, h, t - time[b], S0b, D0, x1 ? S0b + ns : 0, s1, late_S);
            output_sensitive(late_x, late_S, u + b * NU, p, nc, column, late_y, late_J);
            y[j] = late_y[j];
            memcpy(J + j * nc, late_J + j * nc, nc * sizeof(double));
            if (delay_to[j] >= 0) {
                /* dy/d(delay) = -C dx/dt, by a difference along the trajectory. */
                double ahead[NX], late_d[NX], value[NY], w[W], e = 1e-6;
                if (x1)
                    rates(late_x, u + b * NU, p, late_d);
                else
                    memcpy(late_d, d0, sizeof late_d);
                for (int i = 0; i < NX; i++) ahead[i] = late_x[i] + e * late_d[i];
                const double *arg[3] = {ahead, u + b * NU, p};
                double *res[1] = {value};
                cgm_h(arg, res, 0, w, 0);
                slope = -(value[j] - late_y[j]) / e;
                J[j * nc + delay_to[j]] += slope;
            }
        }
        for (int j = 0; j < NY; j++) {
            const double *row = J + j * nc;
            if (Y) Y[k * NY + j] = y[j];
            if (Jacobian) memcpy(Jacobian + ((size_t)k * NY + j) * nc, row, nc * sizeof(double));
            double m = measured[k * NY + j];
            if (m != m || y[j] != y[j]) continue;
            double w2 = weight[j] * weight[j], r = y[j] - m;
            sse[j] += w2 * r * r;
            count[j] += 1;
            for (int a = 0; a < nc; a++) {
                double wa = w2 * row[a];
                if (wa == 0) continue;
                g[a] += wa * r;
                double *Ha = H + a * nc;
                for (int c = 0; c < nc; c++) Ha[c] += wa * row[c];
            }
        }
        if (k + 1 == n) break;
        double dt = time[k + 1] - time[k];
        int m = steps_of(dt, largest);
        for (int i = 0; i < m; i++)
            follow_sensitive(x, S, uk, duk, delay_column, p, nc, column, dt / m, tolerance,
                             &pace);
        if (!sane(x)) return k + 1;
    }
    return n;
}
