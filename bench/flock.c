/* Many walking robots move on, WIDTH side by side: included by flock.py below vector_math.c and the
   code of the robot, as in rollouts.c. Each has its own parameters, torque, ground and time. */

#define HALVINGS 46

struct ground {
    const double *slope, *rise; /* tangent of the fall ahead; next foothold above this one, m */
    double minimum_step;
    long length_at;
};

static inline __attribute__((always_inline)) void rates(int st, const vd *x, const vd *u,
                                                        const vd *c, vd *dx)
{
    if (st) rates_1(x, u, c, dx);
    else rates_0(x, u, c, dx);
}

static inline __attribute__((always_inline)) void runge_kutta(int st, const vd *x, const vd *u,
                                                              const vd *c, vd h, vd *after)
{
    vd k[NX], sum[NX], y[NX];
    rates(st, x, u, c, k);
    for (int i = 0; i < NX; i++) sum[i] = k[i], y[i] = x[i] + 0.5 * h * k[i];
    rates(st, y, u, c, k);
    for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], y[i] = x[i] + 0.5 * h * k[i];
    rates(st, y, u, c, k);
    for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], y[i] = x[i] + h * k[i];
    rates(st, y, u, c, k);
    for (int i = 0; i < NX; i++) after[i] = x[i] + h * (1.0 / 6.0) * (sum[i] + k[i]);
}

/* How far the swing foot is ahead, and over the ground. */
static inline void foot(int st, const vd *x, vd length, vd slope, vd rise, vd *reach, vd *height)
{
    vd s[2], c[2];
    for (int i = 0; i < 2; i++) v_sincos(x[i], &s[i], &c[i]);
    *reach = length * (s[st] - s[1 - st]);
    *height = length * (c[st] - c[1 - st]) + *reach * slope - rise;
}

static inline int any(vi mask)
{
    long long found = 0;
    for (int j = 0; j < WIDTH; j++) found |= mask[j];
    return found != 0;
}

/* Robots of one stance leg: x (n, NX) in and out, u (n), p (n, NP), h (n). `rest`: time that is
   left after a landing, which x is right after; -1 where nobody landed. */
static inline __attribute__((always_inline)) void
moved(int st, long n, double *x, const double *u, const double *p, const double *h,
      const struct ground *g, double *rest)
{
    for (long first = 0; first < n; first += WIDTH) {
        vd from[NX], to[NX], y[NX], input[NU], q[NP], c[CONSTANTS], landing[CONSTANTS], v[2];
        vd time, slope, rise, reach, above, below;
        for (int j = 0; j < WIDTH; j++) {
            long b = first + j < n ? first + j : n - 1;
            for (int i = 0; i < NX; i++) from[i][j] = x[b * NX + i];
            for (int i = 0; i < NP; i++) q[i][j] = p[b * NP + i];
            input[0][j] = u[b], time[j] = h[b], slope[j] = g->slope[b], rise[j] = g->rise[b];
        }
        for (int i = 1; i < NU; i++) input[i] = SPLAT(1.0);
        vd length = q[g->length_at];
        if (st) prepare_1(q, c);
        else prepare_0(q, c);
        runge_kutta(st, from, input, c, time, to);
        foot(st, from, length, slope, rise, &reach, &above);
        foot(st, to, length, slope, rise, &reach, &below);
        vi down = (above > 0.0) & (below <= 0.0) & (reach > g->minimum_step);
        vd part = time;
        if (any(down)) {
            vd low = SPLAT(0.0), high = time;
            for (int k = 0; k < HALVINGS; k++) {
                part = 0.5 * (low + high);
                runge_kutta(st, from, input, c, part, y);
                foot(st, y, length, slope, rise, &reach, &above);
                low = v_select(above > 0.0, part, low), high = v_select(above > 0.0, high, part);
            }
            runge_kutta(st, from, input, c, high, y);
            part = high;
            if (st) prepare_land_1(q, landing), land_1(y, input, landing, v);
            else prepare_land_0(q, landing), land_0(y, input, landing, v);
            y[NX / 2] = v[0], y[NX / 2 + 1] = v[1];
            for (int i = 0; i < NX; i++) to[i] = v_select(down, y[i], to[i]);
        }
        for (int j = 0; j < WIDTH && first + j < n; j++) {
            for (int i = 0; i < NX; i++) x[(first + j) * NX + i] = to[i][j];
            rest[first + j] = down[j] ? time[j] - part[j] : -1.0;
        }
    }
}

void flock_move(int st, long n, double *x, const double *u, const double *p, const double *h,
                const struct ground *g, double *rest)
{
    if (st) moved(1, n, x, u, p, h, g, rest);
    else moved(0, n, x, u, p, h, g, rest);
}

/* dx/dt without torque and with 1 N m, (n, NX) each. */
void flock_rates(int st, long n, const double *x, const double *p, double *idle, double *pushed)
{
    for (long first = 0; first < n; first += WIDTH) {
        vd y[NX], input[NU], q[NP], c[CONSTANTS], f[NX];
        for (int i = 1; i < NU; i++) input[i] = SPLAT(1.0);
        for (int j = 0; j < WIDTH; j++) {
            long b = first + j < n ? first + j : n - 1;
            for (int i = 0; i < NX; i++) y[i][j] = x[b * NX + i];
            for (int i = 0; i < NP; i++) q[i][j] = p[b * NP + i];
        }
        if (st) prepare_1(q, c);
        else prepare_0(q, c);
        for (int unit = 0; unit < 2; unit++) {
            input[0] = SPLAT((double)unit);
            rates(st, y, input, c, f);
            for (int j = 0; j < WIDTH && first + j < n; j++)
                for (int i = 0; i < NX; i++)
                    (unit ? pushed : idle)[(first + j) * NX + i] = f[i][j];
        }
    }
}

/* x (n, NX), before an impact that ends stance st, becomes what it is right after. */
void flock_land(int st, long n, double *x, const double *p)
{
    for (long b = 0; b < n; b++) {
        vd y[NX], input[NU], q[NP], landing[CONSTANTS], v[2];
        for (int i = 0; i < NU; i++) input[i] = SPLAT(0.0);
        for (int i = 0; i < NX; i++) y[i] = SPLAT(x[b * NX + i]);
        for (int i = 0; i < NP; i++) q[i] = SPLAT(p[b * NP + i]);
        if (st) prepare_land_1(q, landing), land_1(y, input, landing, v);
        else prepare_land_0(q, landing), land_0(y, input, landing, v);
        x[b * NX + NX / 2] = v[0][0], x[b * NX + NX / 2 + 1] = v[1][0];
    }
}
