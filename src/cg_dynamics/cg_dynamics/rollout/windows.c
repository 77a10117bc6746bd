/* Sensitivities along a rollout that is known, WIDTH windows of it side by side in the lanes of
   vector registers.

   The variational equations are linear, so a window can set out before the ones before it are
   done: its sensitivities are those by its own first state, by the parameters and by the delay of
   the inputs, and the caller chains the windows. Compiled once, below vector_math.c, windows.h and
   the sizes HALVINGS and STABLE, and linked to each model's own code. Columns of a window: its first
   state, the free parameters by place[nf] (-1: held constant), and the delay by late (or -1). */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NX window_model.nx
#define NU window_model.nu
#define NY window_model.ny
#define COLUMNS (NX + window_model.nf + 1)
#define LOCAL window_model.local

static const int WHOLE = 1 << HALVINGS;

/* What is kept of a row of the windows for late sensors: state (nx) and sensitivities (nx COLUMNS),
   and their slopes. Rows lie one behind the other, and the one `depth` later takes the place. */
typedef struct {
    vd *x, *dx, *S, *dS;
} Row;

static int size_of_row(void) { return 2 * NX * (1 + COLUMNS); }

static Row row_of(vd *rows, size_t k)
{
    vd *x = rows + k * size_of_row(), *S = x + 2 * NX;
    return (Row){x, x + NX, S, S + NX * COLUMNS};
}

static int steps_of(double dt, double largest)
{
    int n = (int)ceil(dt / largest * (1 - 1e-9));
    return n < 1 ? 1 : n;
}

/* The length of a step from `done` on, in smallest steps, where the bits of `steps` say where steps
   begin. */
static int length_of(unsigned steps, int done)
{
    int length = 1;
    while (done + length < WHOLE && !(steps >> (done + length) & 1)) length++;
    return length;
}

/* All columns of a window; their number is the caller's. */
static void columns_of(const int *place, int late, Column *all)
{
    const int (*by)[3] = window_model.by_free;
    int n = 0;
    for (; n < NX; n++) all[n] = (Column){n, 0, 0, by};
    for (int f = 0; f < window_model.nf; f++) {
        int entries = 0;
        while (by[entries][1] == f) entries++;
        if (place[f] >= 0) all[n++] = (Column){place[f], entries, 0, by};
        by += entries;
    }
    if (late < 0) return;
    int entries = 0;
    while (window_model.by_input[entries][1] < NU) entries++;
    all[n] = (Column){late, entries, 1, window_model.by_input};
}

/* h seconds of the state and its sensitivities in place, each window by the steps that its rollout
   took: so these are the derivatives of what was simulated. Where a sensitivity would be unstable
   at a state that rests, steps are halved. */
static void follow(vd *x, vd *S, const vd *u, const vd *du, const vd *s, int nc,
                   const Column *columns, vd h, const unsigned *steps)
{
    const int nx = NX, local = LOCAL;
    vd o[4 * local], y[nx];
    int done[WIDTH] = {0};
    for (int going = 1; going;) {
        vd part;
        window_model.rates_by(x, u, s, o);
        const vd rate = window_model.decay(o);
        going = 0;
        for (int l = 0; l < WIDTH; l++) {
            /* Windows that have arrived wait with steps of no length. */
            int length = done[l] < WHOLE ? length_of(steps[l], done[l]) : 0;
            while (length > 1 && h[l] * length / WHOLE * rate[l] > STABLE) length /= 2;
            part[l] = h[l] * length / WHOLE;
            done[l] += length;
            going |= done[l] < WHOLE;
        }
        for (int stage = 1; stage < 4; stage++) {
            const vd ahead = stage < 3 ? 0.5 * part : part, *k = o + (stage - 1) * local;
            for (int i = 0; i < nx; i++) y[i] = x[i] + ahead * k[i];
            window_model.rates_by(y, u, s, o + stage * local);
        }
        for (int i = 0; i < nx; i++)
            x[i] += part / 6.0
                    * (o[i] + 2.0 * o[local + i] + 2.0 * o[2 * local + i] + o[3 * local + i]);
        window_model.step(o, part, S, du, nc, columns);
    }
}

/* Rows of which a sensor that is late by `delay` needs two. */
static int depth_of(double delay, const int *first, const int *length, const double *time)
{
    int depth = 2;
    for (int l = 0; l < WIDTH; l++) {
        const double *t = time + first[l];
        for (int now = 0, i = 0; now < length[l]; now++) {
            while (i < now && t[i + 1] <= t[now] - delay) i++;
            if (now - i + 2 > depth) depth = now - i + 2;
        }
    }
    return depth;
}

/* What late sensors saw `delay` seconds ago: the Jacobian J of all outputs then, C, and the rates. */
static void look_back(int k, double delay, vd *history, int depth, const int *first,
                      const int *length, const double *time, const double *u, const double *du,
                      const vd *s, int nc, const Column *columns, const int *place, vd *C, vd *J,
                      vd *dx)
{
    const int nx = NX, nu = NU, all = nx * COLUMNS;
    int at[WIDTH], next[WIDTH], alike = 1;
    vd past, h, held[nu + 1], slope_held[nu + 1], x[nx], S[all], end[all], o[LOCAL];
    vi before = {0};
    for (int l = 0; l < WIDTH; l++) {
        const int now = k < length[l] ? k : length[l] - 1;
        const double *t = time + first[l], seen = t[now] - delay;
        int i = now;
        while (i > 0 && t[i] > seen) i--;
        /* Before the first row nobody simulated: straight on from there. */
        const int straight = i == now || seen <= t[0];
        before[l] = straight ? -1 : 0;
        past[l] = seen - t[i];
        h[l] = straight ? 1 : t[i + 1] - t[i];
        /* A window that has ended looks back from where the others are. */
        at[l] = (k - now + i) % depth, next[l] = straight ? at[l] : (at[l] + 1) % depth;
        alike &= at[l] == at[0] && next[l] == next[0];
        for (int v = 0; v < nu; v++) {
            held[v][l] = u[(first[l] + i) * nu + v];
            slope_held[v][l] = du[(first[l] + i) * nu + v];
        }
    }
    Row a = row_of(history, at[0]), b = row_of(history, next[0]);
    vd apart[alike ? 1 : 2 * size_of_row()];
    if (!alike) {
        a = row_of(apart, 0), b = row_of(apart, 1);
        for (int l = 0; l < WIDTH; l++) {
            const vd *from = row_of(history, at[l]).x, *to = row_of(history, next[l]).x;
            for (int i = 0; i < size_of_row(); i++) a.x[i][l] = from[i][l], b.x[i][l] = to[i][l];
        }
    }
    /* The input of a row is held up to the next, so it gives the slope there too. */
    window_model.rates_by(b.x, held, s, o);
    window_model.slopes(o, b.S, slope_held, nc, columns, end);
    const vd q = past / h, r = 1.0 - q, zero = SPLAT(0.0);
    const vd a0 = v_select(before, SPLAT(1.0), (1.0 + 2.0 * q) * r * r);
    const vd a1 = v_select(before, zero, (1.0 + 2.0 * r) * q * q);
    const vd b0 = v_select(before, past, h * q * r * r), b1 = v_select(before, zero, -h * r * q * q);
    for (int v = 0; v < nx; v++) {
        x[v] = a0 * a.x[v] + a1 * b.x[v] + b0 * a.dx[v] + b1 * o[v];
        for (int c = v * COLUMNS; c < v * COLUMNS + nc; c++)
            S[c] = a0 * a.S[c] + a1 * b.S[c] + b0 * a.dS[c] + b1 * end[c];
    }
    window_model.output_sensitive(x, S, held, s, nc, place, C, J);
    window_model.rates_by(x, held, s, o);
    for (int v = 0; v < nx; v++) dx[v] = v_select(before, a.dx[v], o[v]);
}

/* Normal equations of windows of one record, each by its own columns.

   Window l has the rows first[l] .. first[l] + length[l] of time (n), u and du (n, nu), the states
   X (n, nx), their steps (n, most; rollout.c), the residuals R and the weights W (n, ny; 0 where no
   sample is). Its rows from[l] .. until[l]-1 count, and it reports its sensitivities at
   its row handed[l].

   H (WIDTH, nc, nc) and g (WIDTH, nc) are sums of J'WWJ and J'WWR, S (WIDTH, nx, nc) what is
   handed over, Jacobian (n, ny, nc) is filled if not null. delay (ny) in s and delay_to (ny), the
   column of each output's delay or -1, are those of late sensors. Returns 0 if memory is short. */
int cgw_normal(const int *first, const int *length, const int *from, const int *until,
               const int *handed, const double *time, double largest, const double *u, const double *du,
               const double *p, int nc, const int *place, int late, const double *X,
               int most, const int *steps, const double *R, const double *W, const double *delay,
               const int *delay_to, double *H, double *g, double *S_handed, double *Jacobian)
{
    const int nx = NX, nu = NU, ny = NY, stride = COLUMNS, all = nx * stride;
    vd x[nx], S[all], J[ny * stride], C[ny * nx], s[window_model.shared + 1], held[nu + 1],
        slope[nu + 1], o[LOCAL], H_of[stride * stride], g_of[stride], parameters[window_model.np];
    vd then[ny * stride], C_then[ny * nx], dx_then[nx], weight[ny], residual[ny], by[ny];
    Column columns[stride];
    int rows = 0, any_late = 0;
    for (int l = 0; l < WIDTH; l++) rows = length[l] > rows ? length[l] : rows;
    for (int j = 0; j < ny; j++) any_late |= delay[j] > 0 || delay_to[j] >= 0;
    vd *history = 0;
    int depth = 0;
    double longest_delay = 0;
    if (any_late) {
        for (int j = 0; j < ny; j++) longest_delay = fmax(longest_delay, delay[j]);
        depth = depth_of(longest_delay, first, length, time);
        history = aligned_alloc(sizeof(vd), sizeof(vd) * depth * size_of_row());
        if (!history) return 0;
    }
    columns_of(place, late, columns);
    for (int i = 0; i < window_model.np; i++) parameters[i] = SPLAT(p[i]);
    window_model.prepare(parameters, s);
    memset(H_of, 0, sizeof H_of), memset(g_of, 0, sizeof g_of), memset(S, 0, sizeof S);
    for (int i = 0; i < nx; i++) {
        S[i * stride + i] = SPLAT(1.0);
        for (int l = 0; l < WIDTH; l++) x[i][l] = X[first[l] * nx + i];
    }
    for (int k = 0; k < rows; k++) {
        vd dt = {0};
        double longest = 0;
        for (int l = 0; l < WIDTH; l++) {
            const int row = first[l] + (k < length[l] ? k : length[l] - 1);
            if (k + 1 < length[l]) {
                dt[l] = time[row + 1] - time[row];
                longest = dt[l] > longest ? dt[l] : longest;
            }
            for (int v = 0; v < nu; v++)
                held[v][l] = u[row * nu + v], slope[v][l] = du[row * nu + v];
            if (k == handed[l])
                for (int i = 0; i < nx; i++)
                    for (int c = 0; c < nc; c++)
                        S_handed[(l * nx + i) * nc + c] = S[i * stride + c][l];
        }
        if (any_late) {
            const Row now = row_of(history, k % depth);
            window_model.rates_by(x, held, s, o);
            memcpy(now.x, x, sizeof x), memcpy(now.dx, o, sizeof x), memcpy(now.S, S, sizeof S);
            window_model.slopes(o, S, slope, nc, columns, now.dS);
        }
        window_model.output_sensitive(x, S, held, s, nc, place, C, J);
        double looked = NAN; /* sensors that are equally late share a look */
        int any = 0;
        for (int j = 0; j < ny; j++) {
            vd *own = J + j * stride;
            if (delay[j] > 0 || delay_to[j] >= 0) {
                if (delay[j] != looked)
                    look_back(k, looked = delay[j], history, depth, first, length, time, u, du,
                              s, nc, columns, place, C_then, then, dx_then);
                memcpy(own, then + j * stride, sizeof(vd) * nc);
                for (int v = 0; v < nx && delay_to[j] >= 0; v++)
                    own[delay_to[j]] -= C_then[j * nx + v] * dx_then[v];
            }
            weight[j] = residual[j] = SPLAT(0.0);
            for (int l = 0; l < WIDTH; l++) {
                if (k < from[l] || k >= until[l]) continue;
                const int at = (first[l] + k) * ny + j;
                weight[j][l] = W[at] * W[at], residual[j][l] = R[at];
                any |= W[at] != 0;
                for (int c = 0; Jacobian && c < nc; c++) Jacobian[(size_t)at * nc + c] = own[c][l];
            }
        }
        for (int a = 0; a < nc && any; a++) {
            for (int j = 0; j < ny; j++) {
                by[j] = weight[j] * J[j * stride + a];
                g_of[a] += by[j] * residual[j];
            }
            /* Two outputs at a time: with many columns H is the most that is read and written. */
            for (int j = 0; j < ny; j += 2) {
                const int other = j + 1 < ny ? j + 1 : j;
                const vd one = by[j], two = other > j ? by[other] : SPLAT(0.0);
                const vd *J_one = J + j * stride, *J_two = J + other * stride;
                vd *sum = H_of + a * stride;
                for (int c = a; c < nc; c++) sum[c] += one * J_one[c] + two * J_two[c];
            }
        }
        /* Rows of windows whose stamps are not regular may be cut into different intervals. */
        const int cut = steps_of(longest, largest);
        for (int i = 0; i < cut && k + 1 < rows; i++) {
            vd part = {0};
            unsigned taken[WIDTH];
            for (int l = 0; l < WIDTH; l++) {
                const int own = steps_of(dt[l], largest);
                part[l] = i < own ? dt[l] / own : 0;
                taken[l] = k + 1 < length[l] && i < own ? steps[(first[l] + k) * most + i] : 1;
            }
            follow(x, S, held, slope, s, nc, columns, part, taken);
        }
    }
    for (int l = 0; l < WIDTH; l++)
        for (int a = 0; a < nc; a++) {
            g[l * nc + a] = g_of[a][l];
            for (int c = 0; c < nc; c++)
                H[(l * nc + a) * nc + c] = H_of[a < c ? a * stride + c : c * stride + a][l];
        }
    free(history);
    return 1;
}
