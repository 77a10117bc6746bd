/* Slopes and steps of the sensitivities of one model, column by column: each stays in registers for
   the four stages of a step. Included below windows.h and the code that native.py writes for the
   model, on which it depends for the sizes NX, COLUMNS and LOCAL and for times(o, a, b), b = A a. */

/* The slope A a + P of a column whose values are a. */
static inline void slope_of(const Column *c, const vd *o, const vd *du, const vd *a, vd *slope)
{
    const int (*by)[3] = c->by, (*end)[3] = by + c->entries;
    times(o, a, slope);
    if (c->is_delay)
        for (; by < end; by++) slope[(*by)[0]] += o[(*by)[2]] * du[(*by)[1]];
    else
        for (; by < end; by++) slope[(*by)[0]] += o[(*by)[2]];
}

static void slopes(const vd *o, const vd *S, const vd *du, int nc, const Column *columns, vd *dS)
{
    vd a[NX], k[NX];
    for (int n = 0; n < nc; n++) {
        const int c = columns[n].at;
        for (int i = 0; i < NX; i++) a[i] = S[i * COLUMNS + c];
        slope_of(columns + n, o, du, a, k);
        for (int i = 0; i < NX; i++) dS[i * COLUMNS + c] = k[i];
    }
}

static void step(const vd *o, vd h, vd *S, const vd *du, int nc, const Column *columns)
{
    const vd half = 0.5 * h, sixth = h / 6.0;
    vd a[NX], b[NX], k[NX], sum[NX];
    for (int n = 0; n < nc; n++) {
        const int c = columns[n].at;
        for (int i = 0; i < NX; i++) a[i] = S[i * COLUMNS + c];
        slope_of(columns + n, o, du, a, k);
        for (int i = 0; i < NX; i++) sum[i] = k[i], b[i] = a[i] + half * k[i];
        slope_of(columns + n, o + LOCAL, du, b, k);
        for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], b[i] = a[i] + half * k[i];
        slope_of(columns + n, o + 2 * LOCAL, du, b, k);
        for (int i = 0; i < NX; i++) sum[i] += 2.0 * k[i], b[i] = a[i] + h * k[i];
        slope_of(columns + n, o + 3 * LOCAL, du, b, k);
        for (int i = 0; i < NX; i++) S[i * COLUMNS + c] = a[i] + sixth * (sum[i] + k[i]);
    }
}
