/* What rollout.c asks of a model. Below vector_math.c. */

/* Each library has its own. */
#pragma GCC visibility push(hidden)
extern const int parameter_count;
extern const int shared;                                       /* values in s */
extern const double state_scale[];                             /* of each state */
void prepare(const vd *p, vd *s);                              /* of the parameters alone */
void rates(const vd *x, const vd *u, const vd *s, vd *dx);     /* dx/dt */
void outputs(const vd *x, const vd *u, const vd *s, vd *y);    /* what the sensors see */
#pragma GCC visibility pop
