/* Many hybrid rollouts along a tree of nodes at once, WIDTH side by side in vector registers.

   Included below vector_math.c and the code that rollouts.py writes for a robot and what its
   controller knows. For each stance leg s of 0, 1 (1 only if HYBRID):
     prepare_s(p, c), rates_s(x, u, c, dx)      dx/dt, c what depends on parameters alone
     prepare_land_s(p, c), land_s(x, u, c, v)   rates (2) after the impact that ends stance s
   and, if COMPENSATE, of the known model:
     prepare_taken(p, c), taken(rate, u, c, torque)
   and the sizes NX, NU, NP, NL (states that the law looks at), CONSTANTS, and NK, the parameters of the known one.

   The law is (FOL) of docs/trajectories.md, the same as in tracking.py; events are those of
   cg_dynamics/hybrid.py. Rollouts have clocks of their own: a lane that ends takes the next one
   of its leg from a queue, and one that lands goes to the queue of the other leg. */

#include <stdlib.h>

#define LAW (1 + 2 * NL)
#define FORM (NL * (NL + 1) / 2)
#define INSTANT 1e-12
#define NEWTON 8
#define LIMIT_OF_STATES 1e6
#define STILL 1e-3

enum { RUNNING, ARRIVED, FALLEN, LEFT, TIMED_OUT };

struct job {
    /* The tree: leg, next, landing, late, span (n), edge (n, 4, LAW), cost (n, 2, FORM); what
       the controller knows, (NK). */
    const int *leg, *next, *landing, *late;
    const double *span, *edge, *cost, *known;
    /* Goal forms (2, FORM) or null; parameters (NP), or (B, NP) if p_each. */
    const double *goal, *p;
    /* Rollouts, in and out: (B, NX), (B), (B), (B). */
    double *x, *elapsed;
    int *node, *stance;
    /* In: samples to make (B), which inputs are clocks (NU). */
    const int *samples, *clock;
    /* Out: (B) each; nodes that are visited: (B, visits), (B, visits), (B, visits, NL). */
    int *outcome, *impacts;
    double *time;
    int *visited;
    double *visit_cost, *visit_state;
    /* The law; the simulation. */
    double pull, fastest, limit;
    double sample_time, step, fall_angle, minimum_step, ahead, slope;
    long p_each, visits, length_at;
};

/* A rollout while it is in no lane; and what of it is no vector while it is in one. */
struct walk {
    double x[NX], torque, h, elapsed;
    int node, tick, left, visits, fresh;
};

/* Rollouts of one leg that wait for a lane. */
struct queue {
    long *number;
    long size;
};

struct lanes {
    vd x[NX], u[NU], h, elapsed, span, edge[4][LAW], form[2][FORM], c[CONSTANTS];
    long number[WIDTH]; /* -1: idle */
    struct walk *walk[WIDTH];
};

static double form_of(const double *value, const double *slope, double s, const double *d)
{
    double sum = 0;
    for (int i = 0, k = 0; i < NL; i++)
        for (int j = i; j < NL; j++, k++) sum += (value[k] + s * slope[k]) * d[i] * d[j];
    return sum;
}

static void enter(const struct job *job, struct lanes *l, int j)
{
    int node = l->walk[j]->node;
    l->span[j] = job->span[node];
    const double *edge = job->edge + (long)node * 4 * LAW;
    const double *cost = job->cost + (long)node * 2 * FORM;
    for (int k = 0; k < 4; k++)
        for (int i = 0; i < LAW; i++) l->edge[k][i][j] = edge[k * LAW + i];
    for (int k = 0; k < 2; k++)
        for (int i = 0; i < FORM; i++) l->form[k][i][j] = cost[k * FORM + i];
}

/* Move a lane's reference on to the node it is at; note the nodes that are passed. */
static void advance(const struct job *job, struct lanes *l, int j, int st)
{
    struct walk *w = l->walk[j];
    int passed[32], count = 0, node = w->node;
    double s = l->elapsed[j];
    if (job->leg[node] != st) node = job->landing[node], s = 0.0, passed[count++] = node;
    else if (w->fresh) passed[count++] = node;
    while (s >= job->span[node]) {
        s -= job->span[node], node = job->next[node];
        if (count < 32 && !job->late[node]) passed[count++] = node;
    }
    w->node = node, l->elapsed[j] = s;
    enter(job, l, j);
    if (job->visits == 0) return;
    double x[NL], d[NL];
    const double *edge = job->edge + (long)node * 4 * LAW;
    const double *cost = job->cost + (long)node * 2 * FORM;
    for (int i = 0; i < NL; i++) {
        const double *e = edge + 1 + i;
        x[i] = l->x[i][j];
        d[i] = x[i] - (((e[3 * LAW] * s + e[2 * LAW]) * s + e[LAW]) * s + e[0]);
    }
    double away = form_of(cost, cost + FORM, s, d);
    for (int k = 0; k < count && w->visits < job->visits; k++) {
        long at = l->number[j] * job->visits + w->visits++;
        job->visited[at] = passed[k];
        job->visit_cost[at] = away;
        for (int i = 0; i < NL; i++) job->visit_state[at * NL + i] = x[i];
    }
}

/* ds/dt of the phase law. */
static vd phase_rate(const struct job *job, const struct lanes *l)
{
    vd s = l->elapsed, tangent[NL], d[NL], length = SPLAT(0.0), offset = length, trace = length;
    for (int i = 0; i < NL; i++) {
        const int e = 1 + i;
        tangent[i] = (3.0 * l->edge[3][e] * s + 2.0 * l->edge[2][e]) * s + l->edge[1][e];
        d[i] = l->x[i]
               - (((l->edge[3][e] * s + l->edge[2][e]) * s + l->edge[1][e]) * s + l->edge[0][e]);
    }
    for (int i = 0, k = 0; i < NL; i++)
        for (int j = i; j < NL; j++, k++) {
            vd S = l->form[0][k] + s * l->form[1][k];
            length += S * tangent[i] * tangent[j];
            offset += 0.5 * S * (tangent[i] * d[j] + tangent[j] * d[i]);
            if (i == j) trace += S;
        }
    vd rate = 1.0 + job->pull * offset / (length + STILL * trace);
    return v_fmin(v_fmax(rate, SPLAT(1.0 / job->fastest)), SPLAT(job->fastest));
}

static void finish(const struct job *job, struct lanes *l, int j, int st, int outcome)
{
    struct walk *w = l->walk[j];
    long b = l->number[j];
    for (int i = 0; i < NX; i++) job->x[b * NX + i] = l->x[i][j], l->x[i][j] = 0.0;
    job->elapsed[b] = l->elapsed[j];
    job->node[b] = w->node, job->stance[b] = st, job->outcome[b] = outcome;
    job->time[b] = w->tick * job->sample_time - w->left * l->h[j];
    l->h[j] = 0.0, l->number[j] = -1, w->left = 0;
}

static void park(struct lanes *l, int j, struct queue *q)
{
    struct walk *w = l->walk[j];
    for (int i = 0; i < NX; i++) w->x[i] = l->x[i][j];
    w->torque = l->u[0][j], w->h = l->h[j], w->elapsed = l->elapsed[j];
    q->number[q->size++] = l->number[j];
    l->h[j] = 0.0, l->number[j] = -1;
    for (int i = 0; i < NX; i++) l->x[i][j] = 0.0;
}

static inline __attribute__((always_inline)) void prepare(int st, const vd *p, vd *c)
{
#if HYBRID
    if (st) { prepare_1(p, c); return; }
#endif
    prepare_0(p, c);
}

static inline __attribute__((always_inline)) void rates(int st, const vd *x, const vd *u,
                                                        const vd *c, vd *dx)
{
#if HYBRID
    if (st) { rates_1(x, u, c, dx); return; }
#endif
    rates_0(x, u, c, dx);
}

static inline __attribute__((always_inline)) void runge_kutta(int st, vd *x, const vd *u,
                                                              const vd *c, vd h)
{
    vd k[NX], sum[NX], y[NX];
    rates(st, x, u, c, k);
    for (int i = 0; i < NX; i++) sum[i] = k[i], y[i] = x[i] + 0.5 * h * k[i];
    rates(st, y, u, c, k);
    for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], y[i] = x[i] + 0.5 * h * k[i];
    rates(st, y, u, c, k);
    for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], y[i] = x[i] + h * k[i];
    rates(st, y, u, c, k);
    for (int i = 0; i < NX; i++) x[i] += h * (1.0 / 6.0) * (sum[i] + k[i]);
}

static void parameters_of(const struct job *job, const struct lanes *l, vd *p)
{
    for (int j = 0; j < WIDTH; j++) {
        long from = job->p_each && l->number[j] >= 0 ? l->number[j] * NP : 0;
        for (int i = 0; i < NP; i++) p[i][j] = job->p[from + i];
    }
}

#if HYBRID
/* The foot is over ground by 2 l sin((b - a)/2) sin((a + b)/2 - slope) / cos(slope), with a the
   stance leg's angle and b the swing leg's: its sign is that of (b - a)(a + b - 2 slope). */
static inline vd sum_of(const struct job *job, vd a, vd b) { return a + b - 2.0 * job->slope; }

/* Land the lanes that came down between x (before) and y (after a step of l->h); sets `moved`. */
static inline __attribute__((always_inline)) void land(const struct job *job, struct lanes *l,
                                                       int st, const vd *before, vi down,
                                                       struct queue *other)
{
    const int sw = 1 - st;
    vd low = SPLAT(0.0), high = l->h, y[NX], v[2], p[NP], c[CONSTANTS];
    vd from = sum_of(job, before[st], before[sw]);
    vd to = sum_of(job, l->x[st], l->x[sw]);
    vd part = l->h * from / (from - to);
    for (int k = 0; k < NEWTON; k++) {
        part = v_select(down, part, SPLAT(0.0));
        for (int i = 0; i < NX; i++) y[i] = before[i];
        runge_kutta(st, y, l->u, l->c, part);
        vd value = sum_of(job, y[st], y[sw]);
        vi same = (value > 0.0) == (from > 0.0);
        low = v_select(same, part, low), high = v_select(same, high, part);
        vd newton = part - value / (y[NL / 2] + y[NL / 2 + 1]);
        vi inside = (newton >= low) & (newton <= high);
        part = v_select(inside, newton, 0.5 * (low + high));
    }
    part = v_select(down, part, SPLAT(0.0));
    for (int i = 0; i < NX; i++) y[i] = before[i];
    runge_kutta(st, y, l->u, l->c, part);
    parameters_of(job, l, p);
    if (st) prepare_land_1(p, c), land_1(y, l->u, c, v);
    else prepare_land_0(p, c), land_0(y, l->u, c, v);
    vd reach = v_sin(y[st]) - v_sin(y[sw]);
    for (int j = 0; j < WIDTH; j++) {
        /* What is no step: legs that pass each other, a foot too near. */
        double length = p[job->length_at][j];
        if (!down[j] || !(job->ahead * length * reach[j] > job->minimum_step)) continue;
        struct walk *w = l->walk[j];
        for (int i = 0; i < NX; i++) l->x[i][j] = y[i][j];
        /* left was counted down already. */
        double rest = (w->left + 1) * l->h[j] - part[j];
        l->x[NL / 2][j] = v[0][j], l->x[NL / 2 + 1][j] = v[1][j];
        job->impacts[l->number[j]]++;
        w->left = rest > INSTANT ? (int)ceil(rest / job->step - 1e-9) : 0;
        if (rest > INSTANT && w->left < 1) w->left = 1;
        l->h[j] = w->left ? rest / w->left : 0.0;
        park(l, j, other);
    }
}
#endif

/* All that is waiting to stand on leg st, until the other queue is worth more. */
static inline __attribute__((always_inline)) void run(const struct job *job, int st,
                                                      struct walk *walks, long first,
                                                      struct queue *own, struct queue *other)
{
    struct lanes l = {0};
    struct walk nobody = {0};
    const double T = job->sample_time;
    const int steps = (int)ceil(T / job->step - 1e-9) < 1 ? 1 : (int)ceil(T / job->step - 1e-9);
#if COMPENSATE
    vd known[NK], friction[CONSTANTS];
    for (int i = 0; i < NK; i++) known[i] = SPLAT(job->known[i]);
    prepare_taken(known, friction);
#endif
    for (int i = 0; i < NU; i++) l.u[i] = SPLAT(1.0);
    l.u[0] = SPLAT(0.0), l.span = SPLAT(INFINITY);
    for (int j = 0; j < WIDTH; j++) l.number[j] = -1, l.walk[j] = &nobody;
    for (int prepared = 0;;) {
        int active = 0, loaded = 0;
        for (int j = 0; j < WIDTH; j++) {
            if (l.number[j] < 0 && own->size) {
                long b = own->number[--own->size];
                struct walk *w = walks + (b - first);
                l.number[j] = b, l.walk[j] = w;
                for (int i = 0; i < NX; i++) l.x[i][j] = w->x[i];
                l.u[0][j] = w->torque, l.h[j] = w->h, l.elapsed[j] = w->elapsed;
                for (int i = 1; i < NU; i++)
                    if (job->clock[i]) l.u[i][j] = (w->tick - 1) * T;
                enter(job, &l, j);
                loaded = 1;
            }
            if (l.number[j] < 0) l.span[j] = INFINITY, l.elapsed[j] = 0.0, l.walk[j] = &nobody;
            else active++;
        }
        if (!active) return;
        if (active < WIDTH && other->size >= WIDTH) {
            for (int j = 0; j < WIDTH; j++)
                if (l.number[j] >= 0) park(&l, j, own);
            return;
        }
        if (loaded && (job->p_each || !prepared)) {
            vd p[NP];
            parameters_of(job, &l, p);
            prepare(st, p, l.c);
            prepared = 1;
        }

        int asking = 0;
        vi asks;
        for (int j = 0; j < WIDTH; j++) {
            asks[j] = l.number[j] >= 0 && l.walk[j]->left == 0 ? -1 : 0;
            asking |= asks[j] != 0;
        }
        if (asking) {
            vd away = SPLAT(2.0);
            if (job->goal) {
                const double *goal = job->goal + st * FORM;
                away = SPLAT(0.0);
                for (int i = 0, k = 0; i < NL; i++)
                    for (int j = i; j < NL; j++, k++) away += goal[k] * l.x[i] * l.x[j];
            }
            vd rate = job->pull > 0 ? phase_rate(job, &l) : SPLAT(1.0);
            int ended = 0;
            for (int j = 0; j < WIDTH; j++) {
                if (!asks[j]) continue;
                struct walk *w = l.walk[j];
                int other_leg = job->leg[w->node] != st, outcome = RUNNING;
                if (away[j] <= 1.0) outcome = ARRIVED;
                else if (!(fabs(l.x[st][j]) < job->fall_angle)) outcome = FALLEN;
                else if (other_leg && job->landing[w->node] < 0) outcome = LEFT;
                else if (w->tick >= job->samples[l.number[j]]) outcome = TIMED_OUT;
                if (outcome) {
                    finish(job, &l, j, st, outcome);
                    ended = 1, asks[j] = 0;
                    continue;
                }
                if (!w->fresh && !other_leg) l.elapsed[j] += rate[j] * T;
                if (w->fresh || other_leg || l.elapsed[j] >= l.span[j]) advance(job, &l, j, st);
                for (int i = 1; i < NU; i++)
                    if (job->clock[i]) l.u[i][j] = w->tick * T;
                w->fresh = 0, w->left = steps, w->tick++;
                l.h[j] = T / steps;
            }
            vd s = l.elapsed, law[LAW];
            for (int i = 0; i < LAW; i++)
                law[i] = ((l.edge[3][i] * s + l.edge[2][i]) * s + l.edge[1][i]) * s + l.edge[0][i];
            vd torque = law[0];
#if COMPENSATE
            vd slip = l.x[2] - l.x[3], given;
            taken(&slip, 0, friction, &given);
            torque += given;
#endif
            vd feedback = SPLAT(0.0);
            for (int i = 0; i < NL; i++) feedback += law[1 + NL + i] * (l.x[i] - law[1 + i]);
            torque -= feedback;
            torque = v_fmin(v_fmax(torque, SPLAT(-job->limit)), SPLAT(job->limit));
            l.u[0] = v_select(asks, torque, l.u[0]);
            if (ended) continue;
        }

        vd before[NX];
        for (int i = 0; i < NX; i++) before[i] = l.x[i];
        runge_kutta(st, l.x, l.u, l.c, l.h);
        for (int j = 0; j < WIDTH; j++) l.walk[j]->left -= l.number[j] >= 0;
#if HYBRID
        const int sw = 1 - st;
        vd from = sum_of(job, before[st], before[sw]), to = sum_of(job, l.x[st], l.x[sw]);
        vi down = ((before[sw] - before[st]) * from > 0.0)
                  & ((l.x[sw] - l.x[st]) * to <= 0.0) & (from * to <= 0.0);
        int any = 0;
        for (int j = 0; j < WIDTH; j++) {
            if (l.number[j] < 0) down[j] = 0;
            any |= down[j] != 0;
        }
        if (any) land(job, &l, st, before, down, other);
#endif
    }
}

/* Rollouts first .. last-1 of a job; not zero if there is no memory. */
int cgr_follow(const struct job *job, long first, long last)
{
    long count = last - first;
    struct walk *walks = malloc(count * sizeof *walks);
    struct queue queue[2] = {{malloc(count * sizeof(long)), 0}, {malloc(count * sizeof(long)), 0}};
    int failed = !walks || !queue[0].number || !queue[1].number;
    for (long b = last - 1; b >= first && !failed; b--) {
        struct walk *w = walks + (b - first);
        for (int i = 0; i < NX; i++) w->x[i] = job->x[b * NX + i];
        w->torque = w->h = 0.0, w->elapsed = job->elapsed[b];
        w->node = job->node[b], w->tick = w->left = w->visits = 0, w->fresh = 1;
        struct queue *q = queue + job->stance[b];
        q->number[q->size++] = b;
    }
    while (!failed && queue[0].size + queue[1].size) {
#if HYBRID
        if (queue[1].size > queue[0].size) {
            run(job, 1, walks, first, queue + 1, queue);
            continue;
        }
#endif
        run(job, 0, walks, first, queue, queue + 1);
    }
    free(walks), free(queue[0].number), free(queue[1].number);
    return failed;
}
