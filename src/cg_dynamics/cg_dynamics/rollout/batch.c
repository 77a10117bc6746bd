/* Many rollouts of one model at once, WIDTH side by side in the lanes of vector registers.

   Included below vector_math.c and the code that batch.py writes for the model:
     prepare(p, s)          expressions of the parameters alone, SHARED of them
     rates(x, u, s, dx)     dx/dt
   and the sizes NX, NU, NP, SHARED. Rows, holding of inputs and steps are those of rollout.c. */

#include <math.h>

static int steps_of(double dt, double largest)
{
    int n = (int)ceil(dt / largest * (1 - 1e-9));
    return n < 1 ? 1 : n;
}

static inline void runge_kutta(vd *x, const vd *u, const vd *s, double h)
{
    vd k[NX], sum[NX], y[NX];
    rates(x, u, s, k);
    for (int i = 0; i < NX; i++) sum[i] = k[i], y[i] = x[i] + h / 2 * k[i];
    rates(y, u, s, k);
    for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], y[i] = x[i] + h / 2 * k[i];
    rates(y, u, s, k);
    for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], y[i] = x[i] + h * k[i];
    rates(y, u, s, k);
    for (int i = 0; i < NX; i++) x[i] += h / 6 * (sum[i] + k[i]);
}

/* Rollouts first .. last-1 over n rows.

   u is (n, NU), or (rollouts, n, NU) if u_each; p is (NP), or (rollouts, NP) if p_each. With
   K (n, NU, NX) not null, row k holds u - K (x - reference[k]), limited to +-limit[NU].
   X is (rollouts, NX), the states at the last row, or (rollouts, n, NX) if keep. */
void cgb_simulate(long first, long last, int n, const double *dt, double largest, const double *u,
                  int u_each, const double *x0, const double *p, int p_each, const double *K,
                  const double *reference, const double *limit, int keep, double *X)
{
    for (long block = first; block < last; block += WIDTH) {
        long lane[WIDTH];
        vd x[NX], held[NU], parameters[NP], s[SHARED + 1];
        /* The last block repeats its last rollout. */
        for (int j = 0; j < WIDTH; j++) lane[j] = block + j < last ? block + j : last - 1;
        for (int j = 0; j < WIDTH; j++) {
            for (int i = 0; i < NX; i++) x[i][j] = x0[lane[j] * NX + i];
            for (int i = 0; i < NP; i++) parameters[i][j] = p[(p_each ? lane[j] * NP : 0) + i];
        }
        prepare(parameters, s);
        for (int k = 0;; k++) {
            if (keep)
                for (int j = 0; j < WIDTH; j++)
                    for (int i = 0; i < NX; i++) X[(lane[j] * n + k) * NX + i] = x[i][j];
            if (k + 1 == n) break;
            for (int i = 0; i < NU; i++)
                for (int j = 0; j < WIDTH; j++)
                    held[i][j] = u[((u_each ? lane[j] * n : 0) + k) * NU + i];
            if (K)
                for (int i = 0; i < NU; i++) {
                    const double *gain = K + ((long)k * NU + i) * NX;
                    for (int l = 0; l < NX; l++)
                        held[i] -= gain[l] * (x[l] - reference[(long)k * NX + l]);
                    held[i] = v_fmin(v_fmax(held[i], SPLAT(-limit[i])), SPLAT(limit[i]));
                }
            int m = steps_of(dt[k], largest);
            double h = dt[k] / m;
            for (int step = 0; step < m; step++) runge_kutta(x, held, s, h);
        }
        if (!keep)
            for (int j = 0; j < WIDTH; j++)
                for (int i = 0; i < NX; i++) X[lane[j] * NX + i] = x[i][j];
    }
}

/* The elementary functions on arrays, for their tests. n is a multiple of WIDTH. */
void cgb_elementary(long n, const double *x, double *sine, double *cosine, double *exponential,
                    double *hyperbolic)
{
    for (long i = 0; i < n; i += WIDTH) {
        vd a, s, c, e, t;
        for (int j = 0; j < WIDTH; j++) a[j] = x[i + j];
        v_sincos(a, &s, &c);
        e = v_exp(a), t = v_tanh(a);
        for (int j = 0; j < WIDTH; j++)
            sine[i + j] = s[j], cosine[i + j] = c[j], exponential[i + j] = e[j],
                     hyperbolic[i + j] = t[j];
    }
}
