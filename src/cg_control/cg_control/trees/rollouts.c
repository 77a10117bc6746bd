/* Many hybrid rollouts along a tree of nodes at once, WIDTH side by side in vector registers.

   Included below vector_math.c and the code that rollouts.py writes for a robot and what its
   controller knows. For each stance leg s of 0, 1 (1 only if HYBRID):
     prepare_s(p, c), rates_s(x, u, c, dx)      dx/dt, c what depends on parameters alone
     prepare_land_s(p, c), land_s(x, u, c, v)   rates (2) after the impact that ends stance s
   and, if COMPENSATE, of the known model:
     prepare_taken(p, c), taken(angle and rate of the hip, u, c, torque)
   and the sizes NX, NU, NP, NL (states that the law looks at), CONSTANTS, NK (parameters of the
   known model), and LEAST_TURN of the law.

   The law is (FOL) of trajectories.md, the same as in tracking.py; events are those of
   cg_dynamics/hybrid.py. Rollouts have clocks of their own: a lane that ends takes the next one
   of its leg from a queue, and one that lands goes to the queue of the other leg. */

#include <math.h>
#include <stdlib.h>

#define LAW (1 + 2 * NL)
#define FORM (NL * (NL + 1) / 2)
#define INSTANT 1e-12   /* s: less is nothing */
#define NEWTON 60
#define CONVERGED 1e-13 /* s; the next step of Newton's method would be rounding */

enum { RUNNING, ARRIVED, FALLEN, LEFT, TIMED_OUT };
enum { UPRIGHT, TO_ORBIT, ORBIT };

struct job {
    /* The tree: leg, next, landing, late, way, span (n), edge (n, 4, LAW), cost (n, 2, FORM),
       normal (n, 2, NL); what the controller knows, (NK). */
    const int *leg, *next, *landing;
    const unsigned char *late, *way;
    const double *span, *edge, *cost, *normal, *known;
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
    double sample_time, step, fall_angle, swing_angle, minimum_step, ahead, slope;
    long p_each, visits, length_at;
};

/* A rollout while it is in no lane; node and visits also while it is in one. It has begun `tick`
   samples, and `left` steps of h are left of the last one. */
struct walk {
    double x[NX], torque, h, elapsed, left, tick;
    int node, visits;
};

/* Rollouts of one leg that wait for a lane. */
struct queue {
    long *number;
    long size;
};

struct lanes {
    vd x[NX], u[NU], h, elapsed, left, tick, samples, span, edge[4][LAW], form[2][FORM];
    vd normal[2][NL];
    vd c[CONSTANTS], landing[CONSTANTS], length;
    vi upright, orbit;  /* leads upright; is on an orbit, whose tube is a goal */
    vi busy, strange;   /* strange: at the start, or on a leg that is not the node's */
    long number[WIDTH]; /* -1: idle */
    struct walk *walk[WIDTH];
};

static inline int any(vi mask)
{
#if WIDTH == 8
    /* Halves: a loop over the lanes costs as much as a twentieth of a step. */
    typedef long long v4 __attribute__((vector_size(32)));
    typedef long long v2 __attribute__((vector_size(16)));
    union { vi all; v4 half[2]; } eight = {mask};
    union { v4 all; v2 half[2]; } four = {eight.half[0] | eight.half[1]};
    v2 two = four.half[0] | four.half[1];
    return (two[0] | two[1]) != 0;
#else
    long long found = 0;
    for (int j = 0; j < WIDTH; j++) found |= mask[j];
    return found != 0;
#endif
}

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
    const double *normal = job->normal + (long)node * 2 * NL;
    if (job->pull > 0)
        for (int k = 0; k < 2; k++)
            for (int i = 0; i < NL; i++) l->normal[k][i][j] = normal[k * NL + i];
    l->upright[j] = job->way[node] == UPRIGHT ? -1 : 0;
    l->orbit[j] = job->way[node] == ORBIT ? -1 : 0;
    if (job->goal && l->orbit[j])
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
    else if (l->tick[j] == 0.0) passed[count++] = node;
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

/* How far a lane's robot is from its reference. */
static inline void deviation(const struct lanes *l, vd *d)
{
    vd s = l->elapsed;
    for (int i = 0; i < NL; i++) {
        const int e = 1 + i;
        d[i] = l->x[i]
               - (((l->edge[3][e] * s + l->edge[2][e]) * s + l->edge[1][e]) * s + l->edge[0][e]);
    }
}

/* ds/dt of the phase law. */
static vd phase_rate(const struct job *job, const struct lanes *l)
{
    vd d[NL], ahead = SPLAT(0.0), turn = ahead;
    deviation(l, d);
    for (int i = 0; i < NL; i++) {
        ahead += (l->normal[0][i] + l->elapsed * l->normal[1][i]) * d[i];
        turn += l->normal[1][i] * d[i];
    }
    ahead /= v_fmax(1.0 - turn, SPLAT(LEAST_TURN));
    vd rate = 1.0 + job->pull * (ahead - job->sample_time);
    return v_fmin(v_fmax(rate, SPLAT(1.0 / job->fastest)), SPLAT(job->fastest));
}

/* Lanes that are in the tube of an orbit. */
static vi in_tube(const struct lanes *l)
{
    vd d[NL], cost = SPLAT(0.0);
    deviation(l, d);
    for (int i = 0, k = 0; i < NL; i++)
        for (int j = i; j < NL; j++, k++)
            cost += (l->form[0][k] + l->elapsed * l->form[1][k]) * d[i] * d[j];
    return l->orbit & (cost <= 1.0);
}

static void empty(struct lanes *l, int j)
{
    for (int i = 0; i < NX; i++) l->x[i][j] = 0.0;
    l->number[j] = -1, l->busy[j] = 0, l->h[j] = 0.0, l->left[j] = INFINITY;
}

static void finish(const struct job *job, struct lanes *l, int j, int st, int outcome)
{
    long b = l->number[j];
    for (int i = 0; i < NX; i++) job->x[b * NX + i] = l->x[i][j];
    job->elapsed[b] = l->elapsed[j], job->node[b] = l->walk[j]->node;
    job->stance[b] = st, job->outcome[b] = outcome;
    job->time[b] = l->tick[j] * job->sample_time;
    empty(l, j);
}

static void park(struct lanes *l, int j, struct queue *q)
{
    struct walk *w = l->walk[j];
    for (int i = 0; i < NX; i++) w->x[i] = l->x[i][j];
    w->torque = l->u[0][j], w->h = l->h[j], w->elapsed = l->elapsed[j];
    w->left = l->left[j], w->tick = l->tick[j];
    q->number[q->size++] = l->number[j];
    empty(l, j);
}

static void load(const struct job *job, struct lanes *l, int j, int st, struct walk *w, long b)
{
    l->number[j] = b, l->walk[j] = w, l->busy[j] = -1;
    for (int i = 0; i < NX; i++) l->x[i][j] = w->x[i];
    l->u[0][j] = w->torque, l->h[j] = w->h, l->elapsed[j] = w->elapsed;
    l->left[j] = w->left, l->tick[j] = w->tick, l->samples[j] = job->samples[b];
    l->strange[j] = w->tick == 0.0 || job->leg[w->node] != st ? -1 : 0;
    enter(job, l, j);
    /* Its reference has not landed yet. */
    if (job->leg[w->node] != st) l->orbit[j] = 0;
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

/* Land the lanes that came down between l->x and `after`, a step of l->h later. */
static inline __attribute__((always_inline)) void land(const struct job *job, struct lanes *l,
                                                       int st, const vd *after, vi down,
                                                       struct queue *other)
{
    const int sw = 1 - st;
    vd low = SPLAT(0.0), high = l->h, y[NX], v[2];
    vd from = sum_of(job, l->x[st], l->x[sw]), to = sum_of(job, after[st], after[sw]);
    vd part = l->h * from / (from - to);
    /* A lane stops where it has converged by itself: its result must not depend on the others. */
    vi open = down;
    for (int k = 0; k < NEWTON && any(open); k++) {
        part = v_select(down, part, SPLAT(0.0));
        for (int i = 0; i < NX; i++) y[i] = l->x[i];
        runge_kutta(st, y, l->u, l->c, part);
        vd value = sum_of(job, y[st], y[sw]);
        vi same = (value > 0.0) == (from > 0.0);
        low = v_select(same, part, low), high = v_select(same, high, part);
        vd newton = part - value / (y[NL / 2] + y[NL / 2 + 1]);
        vi inside = (newton >= low) & (newton <= high);
        newton = v_select(inside, newton, 0.5 * (low + high));
        vd change = v_fabs(newton - part);
        part = v_select(open, newton, part);
        open &= change > CONVERGED;
    }
    part = v_select(down, part, SPLAT(0.0));
    for (int i = 0; i < NX; i++) y[i] = l->x[i];
    runge_kutta(st, y, l->u, l->c, part);
    if (st) land_1(y, l->u, l->landing, v);
    else land_0(y, l->u, l->landing, v);
    vd reach = v_sin(y[st]) - v_sin(y[sw]);
    for (int j = 0; j < WIDTH; j++) {
        /* What is no step: legs that pass each other, a foot too near. */
        double length = l->length[j];
        if (!down[j] || !(job->ahead * length * reach[j] > job->minimum_step)) continue;
        for (int i = 0; i < NX; i++) l->x[i][j] = y[i][j];
        /* left was counted down already. */
        double rest = (l->left[j] + 1.0) * l->h[j] - part[j];
        l->x[NL / 2][j] = v[0][j], l->x[NL / 2 + 1][j] = v[1][j];
        job->impacts[l->number[j]]++;
        l->left[j] = rest > INSTANT ? fmax(1.0, ceil(rest / job->step - 1e-9)) : 0.0;
        l->h[j] = l->left[j] > 0.0 ? rest / l->left[j] : 0.0;
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
    const double T = job->sample_time, steps = fmax(1.0, ceil(T / job->step - 1e-9));
#if COMPENSATE
    vd known[NK], friction[CONSTANTS];
    for (int i = 0; i < NK; i++) known[i] = SPLAT(job->known[i]);
    prepare_taken(known, friction);
#endif
    for (int i = 1; i < NU; i++) l.u[i] = SPLAT(1.0);
    for (int j = 0; j < WIDTH; j++) empty(&l, j);
    for (int prepared = 0;;) {
        if (any(~l.busy)) {
            int loaded = 0;
            for (int j = 0; j < WIDTH && own->size; j++) {
                if (l.busy[j]) continue;
                long b = own->number[--own->size];
                load(job, &l, j, st, walks + (b - first), b);
                loaded = 1;
            }
            if (!any(l.busy)) return;
            if (any(~l.busy) && other->size >= WIDTH) {
                for (int j = 0; j < WIDTH; j++)
                    if (l.busy[j]) park(&l, j, own);
                return;
            }
            if (loaded && (job->p_each || !prepared)) {
                vd p[NP];
                parameters_of(job, &l, p);
                prepare(st, p, l.c);
                l.length = p[job->length_at];
#if HYBRID
                if (st) prepare_land_1(p, l.landing);
                else prepare_land_0(p, l.landing);
#endif
                prepared = 1;
            }
        }

        vi asks = (l.left == 0.0) & l.busy;
        if (any(asks)) {
            vi arrived = asks & 0, upright = v_fabs(l.x[st]) < job->fall_angle;
#if HYBRID
            upright &= v_fabs(l.x[1 - st]) < job->swing_angle;
#endif
            vi fallen = asks & ~upright;
            if (job->goal) {
                const double *goal = job->goal + st * FORM;
                vd away = SPLAT(0.0);
                for (int i = 0, k = 0; i < NL; i++)
                    for (int j = i; j < NL; j++, k++) away += goal[k] * l.x[i] * l.x[j];
                arrived = asks & l.upright & (away <= 1.0);
                vi orbit = asks & l.orbit;
                if (any(orbit)) arrived |= orbit & in_tube(&l);
            }
            vd rate = job->pull > 0 ? phase_rate(job, &l) : SPLAT(1.0);
            l.elapsed = v_select(asks & ~l.strange, l.elapsed + rate * T, l.elapsed);
            vi special = asks & (l.strange | (l.elapsed >= l.span) | (l.tick >= l.samples));
            int ended = 0;
            if (any(special | arrived | fallen))
                for (int j = 0; j < WIDTH; j++) {
                    if (!(special[j] | arrived[j] | fallen[j])) continue;
                    int node = l.walk[j]->node, outcome = RUNNING;
                    if (arrived[j]) outcome = ARRIVED;
                    else if (fallen[j]) outcome = FALLEN;
                    else if (job->leg[node] != st && job->landing[node] < 0) outcome = LEFT;
                    else if (l.tick[j] >= l.samples[j]) outcome = TIMED_OUT;
                    if (outcome) {
                        /* The sample at which it ends moves the reference no further. */
                        if (!l.strange[j]) l.elapsed[j] -= rate[j] * T;
                        finish(job, &l, j, st, outcome);
                        ended = 1, asks[j] = 0;
                    } else {
                        advance(job, &l, j, st);
                        l.strange[j] = 0;
                    }
                }
            vd s = l.elapsed, law[LAW];
#pragma GCC unroll 16
            for (int i = 0; i < LAW; i++)
                law[i] = ((l.edge[3][i] * s + l.edge[2][i]) * s + l.edge[1][i]) * s + l.edge[0][i];
            vd torque = law[0];
#if COMPENSATE
            vd hip[2] = {l.x[0] - l.x[1], l.x[2] - l.x[3]}, given;
            taken(hip, 0, friction, &given);
            torque += given;
#endif
            vd feedback = SPLAT(0.0);
#pragma GCC unroll 8
            for (int i = 0; i < NL; i++) feedback += law[1 + NL + i] * (l.x[i] - law[1 + i]);
            torque -= feedback;
            torque = v_fmin(v_fmax(torque, SPLAT(-job->limit)), SPLAT(job->limit));
            l.u[0] = v_select(asks, torque, l.u[0]);
            l.h = v_select(asks, SPLAT(T / steps), l.h);
            l.left = v_select(asks, SPLAT(steps), l.left);
            l.tick = v_select(asks, l.tick + 1.0, l.tick);
            if (ended) continue;
        }

#if HYBRID
        const int sw = 1 - st;
        vd from = sum_of(job, l.x[st], l.x[sw]), apart = l.x[sw] - l.x[st];
#endif
        for (int i = 1; i < NU; i++)
            if (job->clock[i]) l.u[i] = v_select(l.busy, l.tick * T - l.left * l.h, l.u[i]);
        vd x[NX];
        for (int i = 0; i < NX; i++) x[i] = l.x[i];
        runge_kutta(st, x, l.u, l.c, l.h);
        l.left -= 1.0;
#if HYBRID
        vd to = sum_of(job, x[st], x[sw]);
        vi down = (apart * from > 0.0) & ((x[sw] - x[st]) * to <= 0.0) & (from * to <= 0.0);
        down &= l.busy;
        if (any(down)) land(job, &l, st, x, down, other);
#endif
        for (int i = 0; i < NX; i++) l.x[i] = x[i];
    }
}

/* Rollouts first .. last-1 of a job; not zero if there is no memory. */
int cgr_follow(const struct job *job, long first, long last)
{
    long count = last - first;
    if (count <= 0) return 0;
    struct walk *walks = malloc(count * sizeof *walks);
    struct queue queue[2] = {{malloc(count * sizeof(long)), 0}, {malloc(count * sizeof(long)), 0}};
    int failed = !walks || !queue[0].number || !queue[1].number;
    for (long b = last - 1; b >= first && !failed; b--) {
        struct walk *w = walks + (b - first);
        for (int i = 0; i < NX; i++) w->x[i] = job->x[b * NX + i];
        w->torque = w->h = 0.0, w->elapsed = job->elapsed[b];
        w->node = job->node[b], w->visits = 0, w->tick = w->left = 0.0;
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
