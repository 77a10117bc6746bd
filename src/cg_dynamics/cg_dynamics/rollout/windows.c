/* Sensitivities along a rollout that is known, WIDTH windows of it side by side in the lanes of
   vector registers.

   The variational equations are linear, so a window can set out before the ones before it are
   done: its sensitivities are those by its own first state, by the parameters and by the delay of
   the inputs, and the caller chains the windows. Included below vector_math.c and the code that
   rollout.py writes for the model, on which it depends for
     prepare(p, s)                                    expressions of the parameters alone
     variational(x, S, u, du, s, nc, place, late, dx, dS)   dx = f, dS = A S + P; returns -trace A
     output_sensitive(x, S, u, s, nc, place, C, J)    J = C S + D, and C
   and the sizes NX, NU, NP, NF, NY, SHARED, HALVINGS and STABLE. Columns of a window: its first
   state, the free parameters by place[NF] (-1: held constant), and the delay by late (or -1). */

#include <stdlib.h>
#include <string.h>

static const int WHOLE = 1 << HALVINGS;

typedef struct {
    vd x[NX], dx[NX], S[NX][COLUMNS], dS[NX][COLUMNS];
} Row;

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

/* h seconds of the state and its sensitivities in place, each window by the steps that its rollout
   took: so these are the derivatives of what was simulated. Where a sensitivity would be unstable
   at a state that rests, steps are halved. */
static void follow(vd *x, vd (*S)[COLUMNS], const vd *u, const vd *du, const vd *s, int nc,
                   const int *place, int late, vd h, const unsigned *steps)
{
    vd k1[NX], k2[NX], k3[NX], k4[NX], y[NX];
    vd s1[NX][COLUMNS], s2[NX][COLUMNS], s3[NX][COLUMNS], s4[NX][COLUMNS], T[NX][COLUMNS];
    int done[WIDTH] = {0};
#define STAGE(K, SK, FACTOR, KN, SN)                                                              \
    for (int i = 0; i < NX; i++) {                                                                \
        y[i] = x[i] + (FACTOR) * K[i];                                                            \
        for (int c = 0; c < nc; c++) T[i][c] = S[i][c] + (FACTOR) * SK[i][c];                     \
    }                                                                                             \
    variational(y, T, u, du, s, nc, place, late, KN, SN);
    for (int going = 1; going;) {
        vd part;
        const vd decay = variational(x, S, u, du, s, nc, place, late, k1, s1);
        going = 0;
        for (int l = 0; l < WIDTH; l++) {
            /* Windows that have arrived wait with steps of no length. */
            int length = done[l] < WHOLE ? length_of(steps[l], done[l]) : 0;
            while (length > 1 && h[l] * length / WHOLE * decay[l] > STABLE) length /= 2;
            part[l] = h[l] * length / WHOLE;
            done[l] += length;
            going |= done[l] < WHOLE;
        }
        STAGE(k1, s1, part / 2.0, k2, s2)
        STAGE(k2, s2, part / 2.0, k3, s3)
        STAGE(k3, s3, part, k4, s4)
        for (int i = 0; i < NX; i++) {
            x[i] += part / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
            for (int c = 0; c < nc; c++)
                S[i][c] += part / 6.0 * (s1[i][c] + 2.0 * s2[i][c] + 2.0 * s3[i][c] + s4[i][c]);
        }
    }
}

/* The output j of a late sensor: its row J of the Jacobian at what it saw `delay` seconds ago.
   history holds the rows 0 .. k of the windows, which begin early enough. */
static void late_output(int j, int k, double delay, int delay_to, const Row *history,
                        const int *first, const int *length, const double *time, const double *u,
                        const double *du, const vd *s, int nc, const int *place, int late, vd *J)
{
    Row a, b;
    vd past, h, held[NU], slope_held[NU], x[NX], S[NX][COLUMNS], dx[NX], dS[NX][COLUMNS];
    vd C[NY][NX], all[NY][COLUMNS];
    vi before = {0};
    for (int l = 0; l < WIDTH; l++) {
        const int now = k < length[l] ? k : length[l] - 1;
        const double *t = time + first[l], seen = t[now] - delay;
        int i = now;
        while (i > 0 && t[i] > seen) i--;
        /* Before the first row nobody simulated: straight on from there. */
        const int straight = i == now || seen <= t[0];
        const int next = straight ? i : i + 1;
        before[l] = straight ? -1 : 0;
        past[l] = seen - t[i];
        h[l] = straight ? 1 : t[next] - t[i];
        for (int v = 0; v < NX; v++) {
            a.x[v][l] = history[i].x[v][l], a.dx[v][l] = history[i].dx[v][l];
            b.x[v][l] = history[next].x[v][l];
            for (int c = 0; c < nc; c++) {
                a.S[v][c][l] = history[i].S[v][c][l], a.dS[v][c][l] = history[i].dS[v][c][l];
                b.S[v][c][l] = history[next].S[v][c][l];
            }
        }
        for (int v = 0; v < NU; v++) {
            held[v][l] = u[(first[l] + i) * NU + v];
            slope_held[v][l] = du[(first[l] + i) * NU + v];
        }
    }
    /* The input of a row is held up to the next, so it gives the slope there too. */
    variational(b.x, b.S, held, slope_held, s, nc, place, late, b.dx, b.dS);
    const vd q = past / h, r = 1.0 - q, zero = SPLAT(0.0);
    const vd a0 = v_select(before, SPLAT(1.0), (1.0 + 2.0 * q) * r * r);
    const vd a1 = v_select(before, zero, (1.0 + 2.0 * r) * q * q);
    const vd b0 = v_select(before, past, h * q * r * r), b1 = v_select(before, zero, -h * r * q * q);
    for (int v = 0; v < NX; v++) {
        x[v] = a0 * a.x[v] + a1 * b.x[v] + b0 * a.dx[v] + b1 * b.dx[v];
        for (int c = 0; c < nc; c++)
            S[v][c] = a0 * a.S[v][c] + a1 * b.S[v][c] + b0 * a.dS[v][c] + b1 * b.dS[v][c];
    }
    output_sensitive(x, S, held, s, nc, place, C, all);
    for (int c = 0; c < nc; c++) J[c] = all[j][c];
    if (delay_to < 0) return;
    variational(x, S, held, slope_held, s, nc, place, late, dx, dS);
    for (int v = 0; v < NX; v++) J[delay_to] -= C[j][v] * v_select(before, a.dx[v], dx[v]);
}

/* Normal equations of windows of one record, each by its own columns.

   Window l has the rows first[l] .. first[l] + length[l] of time (n), u and du (n, NU), the states
   X (n, NX), their steps (n, most; rollout.c), the residuals R and the weights W (n, NY; 0 where no
   sample is). Its rows from[l] .. until[l]-1 count, and it reports its sensitivities at
   its row handed[l].

   H (WIDTH, nc, nc) and g (WIDTH, nc) are sums of J'WWJ and J'WWR, S (WIDTH, NX, nc) what is
   handed over, Jacobian (n, NY, nc) is filled if not null. delay (NY) in s and delay_to (NY), the
   column of each output's delay or -1, are those of late sensors. Returns 0 if memory is short. */
int cgw_normal(const int *first, const int *length, const int *from, const int *until,
               const int *handed, const double *time, double largest, const double *u, const double *du,
               const double *p, int nc, const int *place, int late, const double *X,
               int most, const int *steps, const double *R, const double *W, const double *delay,
               const int *delay_to, double *H, double *g, double *S_handed, double *Jacobian)
{
    vd x[NX], S[NX][COLUMNS], J[NY][COLUMNS], C[NY][NX], parameters[NP], s[SHARED + 1], held[NU],
        slope[NU], HH[COLUMNS][COLUMNS], gg[COLUMNS];
    int rows = 0, any_late = 0;
    for (int l = 0; l < WIDTH; l++) rows = length[l] > rows ? length[l] : rows;
    for (int j = 0; j < NY; j++) any_late |= delay[j] > 0 || delay_to[j] >= 0;
    Row *history = any_late ? aligned_alloc(sizeof(vd), rows * sizeof(Row)) : 0;
    if (any_late && !history) return 0;
    for (int i = 0; i < NP; i++) parameters[i] = SPLAT(p[i]);
    prepare(parameters, s);
    memset(HH, 0, sizeof HH), memset(gg, 0, sizeof gg), memset(S, 0, sizeof S);
    for (int i = 0; i < NX; i++) {
        S[i][i] = SPLAT(1.0);
        for (int l = 0; l < WIDTH; l++) x[i][l] = X[first[l] * NX + i];
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
            for (int v = 0; v < NU; v++) held[v][l] = u[row * NU + v], slope[v][l] = du[row * NU + v];
            if (k == handed[l])
                for (int i = 0; i < NX; i++)
                    for (int c = 0; c < nc; c++) S_handed[(l * NX + i) * nc + c] = S[i][c][l];
        }
        if (any_late) {
            Row *now = history + k;
            memcpy(now->x, x, sizeof x), memcpy(now->S, S, sizeof S);
            variational(x, S, held, slope, s, nc, place, late, now->dx, now->dS);
        }
        output_sensitive(x, S, held, s, nc, place, C, J);
        for (int j = 0; j < NY; j++) {
            if (delay[j] > 0 || delay_to[j] >= 0)
                late_output(j, k, delay[j], delay_to[j], history, first, length, time, u, du, s,
                            nc, place, late, J[j]);
            vd weight = {0}, residual = {0};
            int any = 0;
            for (int l = 0; l < WIDTH; l++) {
                if (k < from[l] || k >= until[l]) continue;
                const int at = (first[l] + k) * NY + j;
                weight[l] = W[at] * W[at], residual[l] = R[at];
                any |= W[at] != 0;
                for (int c = 0; Jacobian && c < nc; c++) Jacobian[(size_t)at * nc + c] = J[j][c][l];
            }
            if (!any) continue;
            for (int a = 0; a < nc; a++) {
                const vd wa = weight * J[j][a];
                gg[a] += wa * residual;
                for (int c = a; c < nc; c++) HH[a][c] += wa * J[j][c];
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
            follow(x, S, held, slope, s, nc, place, late, part, taken);
        }
    }
    for (int l = 0; l < WIDTH; l++)
        for (int a = 0; a < nc; a++) {
            g[l * nc + a] = gg[a][l];
            for (int c = 0; c < nc; c++) H[(l * nc + a) * nc + c] = HH[a < c ? a : c][a < c ? c : a][l];
        }
    free(history);
    return 1;
}
