/* Gate: what becomes of the commands of one cycle, joint by joint; `gate.py` lays out the structs and reports.
 *
 * Arithmetic is IEEE double in the order in which it stands here, with numpy's rules for NaN: `least` and `most`
 * pass it on, `fleast` and `fmost` take the other number. Build with -ffp-contract=off.
 */

#include <math.h>
#include <stdint.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: an object of another one is refused, as gate.py reads the structs here */
#endif
#define SLOW_START_NS 1000000000 /* policy_plan.py */
#define BRAKING_S 0.1   /* s; a joint in velocity mode may come nearer to a position limit by as much of the way that
is left in this time, so it comes to rest there, and with an acceleration limit this is how long a velocity counts to
act until the next one; [i] several times what a servo takes to follow (XM430: some 20 ms) */
#define STARTS_S 0.005  /* s; an anchored joint begins to move when its goal is farther away than the slow speed leads in
this time, 0.4 deg: above the corrections of a controller that holds a weight [i] */
#define FADING_S 0.5    /* s; how long a measured change of velocity counts */
#define LAG_S 0.15      /* s; how long a servo in velocity mode goes on as before, an XM430 with 0.06 kg m^2 by its
integral gain [i] */
#define SEEN 1e-9       /* rad; a goal that is less behind its command was not held back: rounding of a sum of steps */
#define SLOWEST 0.01    /* rad/s; a commanded speed toward a position counts as at least this, so that the goal
arrives. The slowest speed of an AX-12 is 0.0116 rad/s, see protocol.md: it never stands still on its way either */
#define ROUNDING (1 + 1e-9) /* differences of goals are off by the rounding of the goals, far below this part of an
acceleration */
#define LARGEST 1.7976931348623157e308

enum { UNKNOWN, POSITION, VELOCITY, EFFORT, PWM, EFFORT_POSITION };                              /* modes.py */
enum { LOWER = 1, UPPER = 2, STEP = 4, TOO_FAST = 8, NOT_FINITE = 16, TOO_STRONG = 32, OVER = 64, OUTWARD = 128 };
enum { OFF = 3, RELEASED = 4 }; /* Torque and Clamp: cycle.py */

typedef struct { /* limits of one joint, infinite where there is none, and what is known of its goal */
    double lower, upper, speed, effort, pwm;
    double acceleration;
    double own_speed;         /* the servo's own: steps at it hold nothing back, so nothing is flagged */
    double highest_speed;     /* the lowest of the two and of what a register of the servo allows */
    double slow_speed;        /* in the first second */
    double back_speed;        /* a joint that went beyond a limit goes back to it no faster */
    double least_band;        /* a joint that is so much too fast is braked with all its effort, or more by `brake` */
    double brakes_at;         /* at which a joint that follows efforts brakes toward a limit */
    double moving;            /* of the goal in the last step, rad/s */
    double target;            /* the command that the goal followed in the last step, within the limits */
    double left;              /* the goal as the last step left it: one that differs was set anew, and is at rest */
    double fence[2];          /* up to where an effort may lead upward and downward: the limits, for a joint that was
    outside of them where it was, infinite: not known yet */
    double last, rise;        /* the measured velocity of the cycle before, and its largest change lately */
    double anchored;          /* the goal that was set where the joint is: its slow time begins when the goal leaves it;
    NaN: it has begun */
    double now_speed, inside, toward, desired; /* in this cycle: the highest speed, the goal, its speed, its end */
    int64_t slow_ns;          /* for how long it is slow still */
    int64_t counts[8];        /* cycles by bit of Clamp */
    int32_t bounded, mode, limp, moves;
} Joint;

typedef struct {
    Joint *joints;
    double *commands[4], *goals[4]; /* position, velocity, effort, pwm */
    const double *position, *velocity;
    const uint8_t *torque;
    uint8_t *clamped, *begun; /* what is done, and what of it was not done in the cycle before */
    uint8_t *before;
    int32_t count;
    int32_t accelerates; /* a joint has an acceleration limit */
} Gate;

uint32_t dxl_source(void)
{
    return SOURCE_CRC;
}

static double least(double a, double b)
{
    return isnan(a) || a < b ? a : b;
}

static double most(double a, double b)
{
    return isnan(a) || a > b ? a : b;
}

static double fleast(double a, double b)
{
    return isnan(b) || a < b ? a : b;
}

static double fmost(double a, double b)
{
    return isnan(b) || a > b ? a : b;
}

static double between(double low, double value, double high)
{
    return least(most(value, low), high);
}

static double number(double value)
{
    return isnan(value) ? 0.0 : between(-LARGEST, value, LARGEST);
}

static int is_led(const Joint *j)
{
    return j->mode == POSITION || j->mode == EFFORT_POSITION;
}

/* The highest speed with which a step of `dt` s may begin `distance` before a limit.
 *
 * A goal's velocity v[k] = (goal[k] - goal[k-1]) / dt[k] changes by at most a dt[k]. From v a goal that brakes in
 * every cycle comes to rest within v^2 / (2 a), whatever the later dt are: its way is the lower Riemann sum of
 * v - a t. So v[k] may be taken where what is left of the distance d behind the step is at least that,
 *
 *     d - v dt >= v^2 / (2 a)   <=>   v <= 2 d / (dt + sqrt(dt^2 + 2 d / a)),
 *
 * and braking at full acceleration in the next cycle keeps this true, for any dt: with v' = v - a dt',
 * d' - v' dt' - v'^2 / (2 a) = (d' - v^2 / (2 a)) + a dt'^2 / 2 >= 0. Without `dt` it is the stopping distance
 * v^2 / (2 a) of ros2_control (joint_limits/src/joint_saturation_limiter.cpp, `stopping_distance`). Where the speed
 * that is sent acts until the next one comes, as in velocity mode, `dt` is the longest time that it may act:
 * v dt + v^2 / (2 a) is the upper Riemann sum.
 */
static double braking_speed(double distance, double dt, double acceleration)
{
    return 2.0 * distance / (dt + sqrt(dt * dt + 2.0 * distance / acceleration));
}

static void rest(Joint *j, double goal)
{
    j->moving = 0.0;
    j->target = j->left = goal;
}

/* Lets the goal of a limp joint be where it stands, whatever is commanded. */
static void stay(const Gate *g, Joint *j, int32_t i)
{
    if (is_led(j) && isfinite(g->position[i])) {
        g->goals[0][i] = g->position[i];
        g->goals[1][i] = NAN;
        rest(j, g->position[i]);
    }
}

/* Position and speed of a joint that is led to positions, without an acceleration limit. */
static void lead(const Gate *g, Joint *j, int32_t i, double dt)
{
    double goal = g->goals[0][i], position = g->commands[0][i], speed = fabs(g->commands[1][i]);
    double step = j->now_speed * dt, lower = fleast(j->lower, goal), upper = fmost(j->upper, goal);
    /* a goal outside of the limits is a limit, too, and one that is NaN is none */
    j->inside = between(fmost(goal - step, lower), position, fleast(goal + step, upper));
    j->toward = between(0.0, speed, least(j->highest_speed, LARGEST));
    j->moves = isfinite(position); /* infinity keeps the last goal */
    int too_fast = j->moves && !isnan(speed) && j->toward != speed;
    if (isinf(position) || (too_fast && isinf(speed)))
        g->clamped[i] |= NOT_FINITE;
    else if (too_fast)
        g->clamped[i] |= TOO_FAST;
    if (too_fast && isinf(speed))
        j->toward = NAN; /* as if none was commanded */
    if (j->moves && position < lower)
        g->clamped[i] |= LOWER;
    if (j->moves && position > upper)
        g->clamped[i] |= UPPER;
    if (j->moves && j->now_speed < j->own_speed && isinf(j->acceleration) && j->inside != between(lower, position, upper))
        g->clamped[i] |= STEP;
}

/* Whether a goal may go to its end at once, within its acceleration limit: the change of velocity; the velocity
 * beside that of the commands, which must vanish when they stop; where the goal comes to rest if it brakes from
 * now on. A goal follows its commands exactly as long as they ask for no more. */
static int passes(const Joint *j, double goal, double dt)
{
    double square = dt * dt, step = j->desired - goal;
    double lower = between(-1e9, j->lower, 1e9), upper = between(-1e9, j->upper, 1e9);
    double end = fabs(step) * step * (0.5 / j->acceleration) / square + j->desired;
    double change = j->acceleration * ROUNDING * square;
    return !(fabs(step - j->moving * dt) > change || fabs(j->target - goal) > change ||
             fabs(end - (lower + upper) / 2) > (upper - lower) / 2);
}

/* Moves a goal toward its command as fast as the acceleration limit allows.
 *
 * The commands' own velocity, their difference to those before, is not braked for. What the goal is behind is made
 * up for with the speed from which it can stop there, so that it does not overshoot a command that stands. Without
 * a command it comes to rest. Toward a position limit it is never faster than it can brake. */
static void steer(const Gate *g, Joint *j, int32_t i, double dt)
{
    double goal = g->goals[0][i], highest = least(j->now_speed, j->own_speed), limit = j->acceleration;
    double lower = between(-1e9, j->lower, 1e9), upper = between(-1e9, j->upper, 1e9);
    /* not held to the step limit: the goal must know how far it is to go to begin to brake in time */
    double desired = goal;
    if (j->moves)
        desired = between(fleast(j->lower, goal), g->commands[0][i], fmost(j->upper, goal));
    if (goal != j->left)
        rest(j, goal);
    double own = (desired - j->target) / dt; /* the velocity of the commands, unless they jump */
    own = fabs(own) <= highest ? own : 0.0;
    double behind = desired - goal - own * dt, fastest = highest;
    if (j->moves && !isnan(j->toward))
        fastest = fleast(highest, fmost(fmost(j->toward, SLOWEST), fabs(own)));
    double velocity = own + copysign(braking_speed(fabs(behind), dt, limit), behind);
    velocity = between(-fastest, velocity, fastest);
    velocity = between(j->moving - limit * dt, velocity, j->moving + limit * dt);
    velocity = between(-braking_speed(fmost(goal - lower, 0.0), dt, limit), velocity,
                       braking_speed(fmost(upper - goal, 0.0), dt, limit));
    /* a sum that rounds past a limit is the limit; a goal that began outside of them stays where it is */
    double stepped = between(fleast(lower, goal), goal + velocity * dt, fmost(upper, goal));
    j->moving = velocity;
    j->target = desired;
    j->left = j->inside = stepped;
    if (j->moves && fabs(stepped - desired) > SEEN)
        g->clamped[i] |= STEP;
    if (!j->moves)
        j->toward = g->goals[1][i];
    j->moves = 1;
}

/* The goal of a joint that is led to positions, from where `lead` or `steer` put it. */
static void set_position(const Gate *g, Joint *j, int32_t i)
{
    if (j->moves) {
        g->goals[0][i] = j->inside;
        g->goals[1][i] = j->toward;
    }
    double ceiling = j->now_speed < j->own_speed ? least(j->now_speed, j->highest_speed) : NAN; /* NaN: no limit */
    if (g->goals[0][i] < j->lower || g->goals[0][i] > j->upper)
        ceiling = fleast(ceiling, j->back_speed); /* its servo is sent to the limit, which it coasted over */
    g->goals[1][i] = fleast(g->goals[1][i], ceiling);
}

/* A value between these ends, flagged where it led out; that of a wheel as it is. */
static double inward(const Gate *g, const Joint *j, int32_t i, double down, double value, double up)
{
    if (!j->bounded)
        return value;
    if (value > up || value < down)
        g->clamped[i] |= OUTWARD;
    return between(down, value, up);
}

/* A finite value of at most this magnitude. */
static double bounded(const Gate *g, const Joint *j, int32_t i, double value, double highest, int bit)
{
    if (isinf(value))
        g->clamped[i] |= NOT_FINITE;
    value = isfinite(value) ? value : 0.0;
    if (fabs(value) > highest) /* the slow start holds a velocity lower than the file's limit */
        g->clamped[i] |= (uint8_t)(bit == TOO_FAST && highest < j->highest_speed ? STEP : bit);
    return between(-highest, value, highest);
}

/* The velocity of a joint in velocity mode, without what leads out of the position limits.
 *
 * A servo is behind its goal by LAG_S, and goes on as long when that becomes less: with a lag of the first order,
 * d - v LAG_S in place of the way d that is left comes to rest at the limit without going beyond,
 * ((LAG_S s + 1) (BRAKING_S s + 1) is the characteristic polynomial). */
static double drive(const Gate *g, const Joint *j, int32_t i, double dt, int64_t dt_ns)
{
    double command = g->commands[1][i], last = g->goals[1][i];
    double value = bounded(g, j, i, command, least(j->now_speed, j->highest_speed), TOO_FAST);
    if (g->accelerates) {
        double before = isnan(last) ? 0.0 : last, change = j->acceleration * dt;
        double ramped = between(before - change, value, before + change);
        if (ramped != value && isfinite(command))
            g->clamped[i] |= STEP;
        value = ramped;
    }
    double ahead = number(g->velocity[i]) * (LAG_S + 1e-9 * (double)dt_ns);
    double up = fmost(j->upper - g->position[i] - fmost(ahead, 0.0), 0.0); /* 0 where the position is not known */
    double down = fmost(g->position[i] - j->lower + fleast(ahead, 0.0), 0.0);
    double seconds = fmost(BRAKING_S, 2e-9 * (double)dt_ns); /* a slow loop sees late how near it came */
    up = g->accelerates ? braking_speed(up, seconds, j->acceleration) : up / seconds;
    down = g->accelerates ? braking_speed(down, seconds, j->acceleration) : down / seconds;
    return inward(g, j, i, -down, value, up);
}

/* An effort or a PWM with which a joint comes to rest at its limits, by measured motion alone.
 *
 * Toward a limit a joint may have `braking_speed`. What may pull it outward becomes smaller as it nears that speed,
 * is 0 at it, and above it pulls back, up to the full effort: a damper that knows no inertia. It is as soft as the
 * joint's measured changes of velocity need it in this period: its pull takes away at most half of what is too much
 * until the next cycle. A joint that is beyond goes back as far as it went beyond, slowly. */
static double brake(const Gate *g, Joint *j, int32_t i, double value, double highest, double dt)
{
    double velocity = number(g->velocity[i]), ends[2];
    j->rise = fmost(fabs(velocity - j->last) / dt, j->rise * fmost(0.0, 1.0 - dt / FADING_S));
    j->last = velocity;
    double band = fmost(j->least_band, 2.0 * dt * j->rise);
    for (int side = 0; side < 2; side++) {
        double sign = side ? -1.0 : 1.0, at = sign * g->position[i];
        j->fence[side] = fmost(sign * (side ? j->lower : j->upper), fleast(j->fence[side], at));
        double left = j->fence[side] - at; /* NaN where the position is not known */
        double allowed = left > 0.0 ? braking_speed(left, 2.0 * dt, j->brakes_at) : fmost(left / BRAKING_S, -j->back_speed);
        double share = between(-1.0, (allowed - sign * velocity) / band, left > 0.0 ? 1.0 : 0.0);
        ends[side] = (isnan(left) ? 0.0 : share) * highest;
    }
    return inward(g, j, i, -ends[1], value, ends[0]);
}

/* The limit of the effort of a joint in mode EFFORT_POSITION. */
static void limit_effort(const Gate *g, const Joint *j, int32_t i)
{
    double value = fabs(g->commands[2][i]), highest = least(j->effort, LARGEST);
    if (value > highest)
        g->clamped[i] |= isinf(value) ? NOT_FINITE : TOO_STRONG;
    g->goals[2][i] = least(isfinite(value) ? value : g->goals[2][i], highest);
}

/* Moves the goals toward the commands; returns 1 where something is done that was not done before. */
int32_t gate_apply(Gate *g, int64_t dt_ns)
{
    double dt = (double)(dt_ns > 1 ? dt_ns : 1) * 1e-9;
    int all_pass = 1;
    for (int32_t i = 0; i < g->count; i++) {
        Joint *j = &g->joints[i];
        int was_limp = j->limp;
        j->limp = g->torque[i] == OFF || g->torque[i] == RELEASED;
        if (was_limp && !j->limp)
            j->slow_ns = SLOW_START_NS; /* it holds where it is, and follows its commands slowly from there on */
        if (was_limp || j->limp)
            stay(g, j, i);
        g->clamped[i] &= NOT_FINITE; /* what the controllers' outputs were found to be */
        j->now_speed = j->slow_ns > 0 ? least(j->speed, j->slow_speed) : j->speed;
        if (is_led(j)) {
            lead(g, j, i, dt);
            j->desired = j->moves ? j->inside : g->goals[0][i];
            all_pass &= isinf(j->acceleration) || passes(j, g->goals[0][i], dt);
        }
    }
    int begun = 0;
    for (int32_t i = 0; i < g->count; i++) {
        Joint *j = &g->joints[i];
        double effort = least(j->effort, LARGEST);
        if (is_led(j)) {
            if (isfinite(j->acceleration) && all_pass) {
                j->moving = (j->desired - g->goals[0][i]) / dt;
                j->target = j->left = j->desired;
            } else if (isfinite(j->acceleration))
                steer(g, j, i, dt);
            set_position(g, j, i);
        } else if (j->mode == VELOCITY)
            g->goals[1][i] = drive(g, j, i, dt, dt_ns);
        else if (j->mode == EFFORT)
            g->goals[2][i] = brake(g, j, i, bounded(g, j, i, g->commands[2][i], effort, TOO_STRONG), effort, dt);
        else if (j->mode == PWM)
            g->goals[3][i] = brake(g, j, i, bounded(g, j, i, g->commands[3][i], j->pwm, OVER), j->pwm, dt);
        if (j->mode == EFFORT_POSITION)
            limit_effort(g, j, i);
        double away = is_led(j) ? g->goals[0][i] - j->anchored : j->mode == VELOCITY ? g->goals[1][i] : INFINITY;
        if (fabs(away) > j->slow_speed * STARTS_S)
            j->anchored = NAN;
        if (j->slow_ns > 0 && isnan(j->anchored))
            j->slow_ns -= dt_ns;
        if (j->limp) {
            g->clamped[i] &= NOT_FINITE; /* what is commanded meanwhile is not followed */
            j->fence[0] = j->fence[1] = INFINITY; /* beyond a limit it is not drawn back to it */
            stay(g, j, i);
        }
        g->begun[i] = g->clamped[i] & (uint8_t)~g->before[i];
        begun |= g->begun[i];
        g->before[i] = g->clamped[i];
        for (int bit = 0; bit < 8; bit++)
            j->counts[bit] += g->clamped[i] >> bit & 1;
    }
    return begun != 0;
}
