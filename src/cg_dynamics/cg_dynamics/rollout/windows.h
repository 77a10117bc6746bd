/* What windows.c asks of a model. Below vector_math.c, whose WIDTH is the number of windows.

   f are the rates; A, B, P their derivatives by state, inputs and free parameters; C, D those of the
   outputs by state and free parameters. Matrices lie row by row, sensitivities S and J with
   nx + nf + 1 columns: the first state, the free parameters, the delay of the inputs. */

/* A column of the sensitivities, and the entries {row, column, place in o} of P or, for the delay,
   of B by which the rates depend on what it stands for. */
typedef struct {
    int at, entries, is_delay;
    const int (*by)[3];
} Column;

typedef struct {
    int nx, nu, np, nf, ny;
    int shared;                 /* expressions of the parameters alone, s */
    int local;                  /* what rates_by says, o: f, and what is not zero of A, B, P */
    const int (*by_input)[3];   /* {row, column, place in o} of B, and of P: by columns, and one */
    const int (*by_free)[3];    /* entry beyond the last column */
    void (*prepare)(const vd *p, vd *s);
    void (*rates_by)(const vd *x, const vd *u, const vd *s, vd *o);
    vd (*decay)(const vd *o);   /* -trace A */
    /* dS = A S + P */
    void (*slopes)(const vd *o, const vd *S, const vd *du, int nc, const Column *columns, vd *dS);
    /* S after a Runge-Kutta step of h seconds; o are the derivatives at its four stages */
    void (*step)(const vd *o, vd h, vd *S, const vd *du, int nc, const Column *columns);
    /* J = C S + D, and C */
    void (*output_sensitive)(const vd *x, const vd *S, const vd *u, const vd *s, int nc,
                             const int *place, vd *C, vd *J);
} WindowModel;

/* Each library has its own. */
extern const WindowModel window_model __attribute__((visibility("hidden")));
