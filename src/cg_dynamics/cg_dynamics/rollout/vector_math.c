/* Elementary functions on WIDTH doubles at once, with the vector types of gcc and clang.

   Errors, tested in test_batch.py over the ranges given: sin and cos 3e-16 absolute for |x| < 1e5;
   exp 5e-16 relative within +-708, saturated beyond; tanh 5e-16 relative. The rounding trick of
   adding 1.5 * 2^52 must survive, so this file is never compiled with -fassociative-math. Without
   math.h: reading it is a tenth of what a small model takes to compile. */

#ifndef WIDTH
#define WIDTH 8
#endif

typedef double vd __attribute__((vector_size(8 * WIDTH)));
typedef long long vi __attribute__((vector_size(8 * WIDTH)));

#define SPLAT(a) ((vd){0} + (a))
#define ROUND_TRICK 6755399441055744.0

static inline vd v_select(vi mask, vd a, vd b)
{
    return (vd)(((vi)a & mask) | ((vi)b & ~mask));
}

static inline vd v_fabs(vd x) { return (vd)((vi)x & 0x7fffffffffffffffLL); }

static inline vd v_copysign(vd size, vd sign)
{
    return (vd)(((vi)size & 0x7fffffffffffffffLL) | ((vi)sign & ~0x7fffffffffffffffLL));
}

static inline void v_sincos(vd x, vd *s, vd *c)
{
    /* x = n pi/2 + r, pi/2 in three parts of 33 bits, |r| <= pi/4 (+ rounding). */
    vd t = x * 0.63661977236758134308 + ROUND_TRICK;
    vi n = (vi)t;
    t -= ROUND_TRICK;
    vd r = x - t * 1.57079632673412561417e+00;
    r -= t * 6.07710050630396597660e-11;
    r -= t * 2.02226624879595063154e-21;
    vd z = r * r;
    vd sine = 1.58969099521155010221e-10 * z - 2.50507602534068634195e-08;
    vd cosine = -1.13596475577881948265e-11 * z + 2.08757232129817482790e-09;
    sine = sine * z + 2.75573137070700676789e-06;
    cosine = cosine * z - 2.75573143513906633035e-07;
    sine = sine * z - 1.98412698298579493134e-04;
    cosine = cosine * z + 2.48015872894767294178e-05;
    sine = sine * z + 8.33333333332248946124e-03;
    cosine = cosine * z - 1.38888888888741095749e-03;
    sine = sine * z - 1.66666666666666324348e-01;
    cosine = cosine * z + 4.16666666666666019037e-02;
    sine = r + r * z * sine;
    cosine = 1.0 - 0.5 * z + z * z * cosine;
    vi odd = -(n & 1);
    *s = (vd)((vi)v_select(odd, cosine, sine) ^ ((n & 2) << 62));
    *c = (vd)((vi)v_select(odd, sine, cosine) ^ (((n + 1) & 2) << 62));
}

static inline vd v_sin(vd x)
{
    vd s, c;
    v_sincos(x, &s, &c);
    return s;
}

static inline vd v_cos(vd x)
{
    vd s, c;
    v_sincos(x, &s, &c);
    return c;
}

static inline vd v_exp(vd x)
{
    x = v_select(x > 708.0, SPLAT(708.0), x);
    x = v_select(x < -708.0, SPLAT(-708.0), x);
    vd t = x * 1.44269504088896340736 + ROUND_TRICK;
    vi n = (vi)t;
    t -= ROUND_TRICK;
    vd r = x - t * 6.93147180369123816490e-01;
    r -= t * 1.90821492927058770002e-10;
    /* Taylor series: r^14/14! < 5e-18 for |r| < 0.35. */
    vd e = r * (1.0 / 6227020800.0) + 1.0 / 479001600.0;
    e = e * r + 1.0 / 39916800.0;
    e = e * r + 1.0 / 3628800.0;
    e = e * r + 1.0 / 362880.0;
    e = e * r + 1.0 / 40320.0;
    e = e * r + 1.0 / 5040.0;
    e = e * r + 1.0 / 720.0;
    e = e * r + 1.0 / 120.0;
    e = e * r + 1.0 / 24.0;
    e = e * r + 1.0 / 6.0;
    e = e * r + 0.5;
    e = e * r + 1.0;
    e = e * r + 1.0;
    return e * (vd)((n + 1023) << 52);
}

static inline vd v_tanh(vd x)
{
    vd a = v_fabs(x), z = x * x;
    /* Near zero a rational function (Cephes), elsewhere 1 - 2/(exp(2|x|) + 1). */
    vd p = (-9.64399179425052238628e-01 * z - 9.92877231001918586564e+01) * z
           - 1.61468768441708447952e+03;
    vd q = ((z + 1.12811678491632931402e+02) * z + 2.23548839060100448583e+03) * z
           + 4.84406305325125486048e+03;
    vd small = x + x * z * (p / q);
    vd large = v_copysign(1.0 - 2.0 / (v_exp(2.0 * a) + 1.0), x);
    return v_select(a < 0.625, small, large);
}

#define LANES(NAME, FUNCTION)                                                                    \
    static inline vd NAME(vd x)                                                                  \
    {                                                                                            \
        for (int i = 0; i < WIDTH; i++) x[i] = FUNCTION(x[i]);                                   \
        return x;                                                                                \
    }
#define LANES2(NAME, FUNCTION)                                                                   \
    static inline vd NAME(vd x, vd y)                                                            \
    {                                                                                            \
        for (int i = 0; i < WIDTH; i++) x[i] = FUNCTION(x[i], y[i]);                             \
        return x;                                                                                \
    }

/* Rare in models: one lane after the other. sqrt becomes one instruction. */
LANES(v_sqrt, __builtin_sqrt)
LANES(v_log, __builtin_log)
LANES(v_tan, __builtin_tan)
LANES(v_asin, __builtin_asin)
LANES(v_acos, __builtin_acos)
LANES(v_atan, __builtin_atan)
LANES(v_sinh, __builtin_sinh)
LANES(v_cosh, __builtin_cosh)
LANES(v_floor, __builtin_floor)
LANES(v_ceil, __builtin_ceil)
LANES2(v_pow, __builtin_pow)
LANES2(v_atan2, __builtin_atan2)
LANES2(v_hypot, __builtin_hypot)

static inline vd v_truth(vi mask) { return (vd)((vi)SPLAT(1.0) & mask); }
static inline vd v_fmin(vd x, vd y) { return v_select(x < y, x, y); }
static inline vd v_fmax(vd x, vd y) { return v_select(x > y, x, y); }
static inline vd v_sign(vd x) { return v_truth(x > 0.0) - v_truth(x < 0.0); }
