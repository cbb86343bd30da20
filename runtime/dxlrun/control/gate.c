/* Gate: turn the commands of one cycle into goals, joint by joint. `gate.py` fills the structs and reports clamps.
 *
 * A replay must give the same bits on every machine. So arithmetic is IEEE double in source order, built with
 * -ffp-contract=off. NaN follows numpy's rules: `least` and `most` propagate NaN, `fleast` and `fmost` return the
 * other number.
 */

#include <math.h>
#include <stdint.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file. gate.py parses the structs here, and refuses an outdated object. */
#endif
#define SLOW_START_NS 1000000000 /* as in policy_plan.py */
#define BRAKING_S 0.1   /* s; time constant with which a joint in velocity mode approaches a position limit, so that
it comes to rest there. With an acceleration limit, a velocity is assumed to act for this time. Several times the
response time of a servo (XM430: some 20 ms) [i] */
#define STARTS_S 0.005  /* s; an anchored joint has begun to move when its goal is farther away than the slow speed
covers in this time: 0.4 deg, more than the corrections of a controller that holds a weight [i] */
#define FADING_S 0.5    /* s; time after which a measured change of velocity is forgotten */
#define LAG_S 0.15      /* s; lag of a servo in velocity mode: an XM430 with 0.06 kg m^2, caused by its integral
gain [i] */
#define SEEN 1e-9       /* rad; a smaller difference between goal and command is rounding of a sum of steps, not a
clamp */
#define SLOWEST 0.01    /* rad/s; lower bound of a commanded speed toward a position, so that the goal arrives. The
slowest speed of an AX-12 is 0.0116 rad/s, see protocol.md: the servo does not stand still on its way either */
#define ROUNDING (1 + 1e-9) /* tolerance for differences of goals; the rounding of goals is far below this share of
an acceleration */
#define LARGEST 1.7976931348623157e308

enum { UNKNOWN, POSITION, VELOCITY, EFFORT, PWM, EFFORT_POSITION };                              /* modes.py */
enum { LOWER = 1, UPPER = 2, STEP = 4, TOO_FAST = 8, NOT_FINITE = 16, TOO_STRONG = 32, OVER = 64, OUTWARD = 128 };
enum { OFF = 3, RELEASED = 4 }; /* Torque and Clamp: cycle.py */

typedef struct { /* limits of one joint, infinite if there is none, and the state of its goal; rad or m */
    double lower, upper, speed, effort, pwm;
    double acceleration;      /* rad/s^2 or m/s^2 */
    double own_speed;         /* top speed of the servo: the servo limits itself, so steps at it are not flagged */
    double highest_speed;     /* minimum of `speed`, `own_speed` and the registers of the servo */
    double slow_speed;        /* speed limit in the first second */
    double back_speed;        /* speed limit of a joint that returns from beyond a position limit */
    double least_band;        /* excess speed that is braked with the full effort; `brake` may widen this band */
    double brakes_at;         /* deceleration toward a position limit in effort and PWM modes, rad/s^2 */
    double moving;            /* velocity of the goal in the last step */
    double target;            /* command that the goal followed in the last step, within the limits */
    double left;              /* goal after the last step; a goal that differs was set elsewhere, and is at rest */
    double fence[2];          /* upper and lower position up to which an effort may move the joint: the limits, or its
    position if it was outside of them; infinite: not known yet */
    double last, rise;        /* measured velocity of the last cycle; its largest recent change, rad/s^2 */
    double anchored;          /* goal that was set to the measured position. The slow start begins when the goal
    leaves it; NaN: the slow start has begun. */
    double now_speed, inside, toward, desired; /* this cycle: highest speed, clamped goal, its speed, final goal */
    int64_t slow_ns;          /* remaining time of the slow start */
    int64_t counts[8];        /* cycles by bit of Clamp */
    int32_t bounded, mode, limp, moves;
} Joint;

typedef struct {
    Joint *joints;
    double *commands[4], *goals[4]; /* position, velocity, effort, pwm */
    const double *position, *velocity;
    const uint8_t *torque;
    uint8_t *clamped, *begun; /* clamps of this cycle; those that were not active in the last cycle */
    uint8_t *before;          /* clamps of the last cycle */
    int32_t count;            /* number of joints */
    int32_t accelerates;      /* 1 if any joint has an acceleration limit */
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

/* Highest speed for a step of `dt` s that begins `distance` before a limit.
 *
 * A goal's velocity v[k] = (goal[k] - goal[k-1]) / dt[k] changes by at most a dt[k]. A goal that brakes from v in
 * every cycle comes to rest within v^2 / (2 a) for any later dt: its way is the lower Riemann sum of v - a t. So
 * v[k] is allowed if at least that distance is left after the step,
 *
 *     d - v dt >= v^2 / (2 a)   <=>   v <= 2 d / (dt + sqrt(dt^2 + 2 d / a)).
 *
 * Braking at full acceleration in the next cycle keeps this true for any dt: with v' = v - a dt',
 * d' - v' dt' - v'^2 / (2 a) = (d' - v^2 / (2 a)) + a dt'^2 / 2 >= 0. For dt = 0 it is the stopping distance
 * v^2 / (2 a) of ros2_control (joint_limits/src/joint_saturation_limiter.cpp, `stopping_distance`). In velocity
 * mode a sent speed acts until the next one arrives. `dt` is then the longest time that it may act, and
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

/* Set the goal of a limp joint to its measured position, so that it does not jump when torque is enabled. */
static void stay(const Gate *g, Joint *j, int32_t i)
{
    if (is_led(j) && isfinite(g->position[i])) {
        g->goals[0][i] = g->position[i];
        g->goals[1][i] = NAN;
        rest(j, g->position[i]);
    }
}

/* Compute position and speed of a joint in a position mode, without its acceleration limit. */
static void lead(const Gate *g, Joint *j, int32_t i, double dt)
{
    double goal = g->goals[0][i], position = g->commands[0][i], speed = fabs(g->commands[1][i]);
    double step = j->now_speed * dt, lower = fleast(j->lower, goal), upper = fmost(j->upper, goal);
    /* A goal outside of the limits widens them: the joint may stay there, but not move further out. */
    j->inside = between(fmost(goal - step, lower), position, fleast(goal + step, upper));
    j->toward = between(0.0, speed, least(j->highest_speed, LARGEST));
    j->moves = isfinite(position); /* infinity keeps the last goal */
    int too_fast = j->moves && !isnan(speed) && j->toward != speed;
    if (isinf(position) || (too_fast && isinf(speed)))
        g->clamped[i] |= NOT_FINITE;
    else if (too_fast)
        g->clamped[i] |= TOO_FAST;
    if (too_fast && isinf(speed))
        j->toward = NAN; /* same as no commanded speed */
    if (j->moves && position < lower)
        g->clamped[i] |= LOWER;
    if (j->moves && position > upper)
        g->clamped[i] |= UPPER;
    if (j->moves && j->now_speed < j->own_speed && isinf(j->acceleration) && j->inside != between(lower, position, upper))
        g->clamped[i] |= STEP;
}

/* Return 1 if a goal may step to its desired position within its acceleration limit.
 *
 * Three quantities must stay within their bounds: the change of velocity; the goal's lag behind the commands,
 * which must vanish when they stop; the position at which the goal comes to rest if it brakes from now on. A goal
 * follows its commands exactly while this holds. */
static int passes(const Joint *j, double goal, double dt)
{
    double square = dt * dt, step = j->desired - goal;
    double lower = between(-1e9, j->lower, 1e9), upper = between(-1e9, j->upper, 1e9);
    double end = fabs(step) * step * (0.5 / j->acceleration) / square + j->desired;
    double change = j->acceleration * ROUNDING * square;
    return !(fabs(step - j->moving * dt) > change || fabs(j->target - goal) > change ||
             fabs(end - (lower + upper) / 2) > (upper - lower) / 2);
}

/* Move a goal toward its command as fast as the acceleration limit allows.
 *
 * The goal's velocity is that of the commands plus a correction for the distance by which the goal lags. The
 * correction is a speed from which the goal can stop within that distance, so it does not overshoot a constant
 * command. Without a command the goal comes to rest. Toward a position limit it is never too fast to brake. */
static void steer(const Gate *g, Joint *j, int32_t i, double dt)
{
    double goal = g->goals[0][i], highest = least(j->now_speed, j->own_speed), limit = j->acceleration;
    double lower = between(-1e9, j->lower, 1e9), upper = between(-1e9, j->upper, 1e9);
    /* Not clamped to the step limit: braking in time requires the whole remaining distance. */
    double desired = goal;
    if (j->moves)
        desired = between(fleast(j->lower, goal), g->commands[0][i], fmost(j->upper, goal));
    if (goal != j->left)
        rest(j, goal);
    double own = (desired - j->target) / dt; /* velocity of the commands; 0 after a jump, and without commands */
    own = j->moves && fabs(own) <= highest ? own : 0.0;
    double behind = desired - goal - own * dt, fastest = highest;
    if (j->moves && !isnan(j->toward))
        fastest = fleast(highest, fmost(fmost(j->toward, SLOWEST), fabs(own)));
    double velocity = own + copysign(braking_speed(fabs(behind), dt, limit), behind);
    velocity = between(-fastest, velocity, fastest);
    velocity = between(j->moving - limit * dt, velocity, j->moving + limit * dt);
    velocity = between(-braking_speed(fmost(goal - lower, 0.0), dt, limit), velocity,
                       braking_speed(fmost(upper - goal, 0.0), dt, limit));
    /* The sum may round past a limit. A goal that started outside of the limits must not jump to them. */
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

/* Write the goal of a joint in a position mode, as computed by `lead` or `steer`. */
static void set_position(const Gate *g, Joint *j, int32_t i)
{
    if (j->moves) {
        g->goals[0][i] = j->inside;
        g->goals[1][i] = j->toward;
    }
    double ceiling = j->now_speed < j->own_speed ? least(j->now_speed, j->highest_speed) : NAN; /* NaN: no limit */
    if (g->goals[0][i] < j->lower || g->goals[0][i] > j->upper)
        ceiling = fleast(ceiling, j->back_speed); /* the servo coasted past the limit and must return slowly */
    g->goals[1][i] = fleast(g->goals[1][i], ceiling);
}

/* Clamp a value that would move the joint out of its limits, and flag it. A wheel has no limits. */
static double inward(const Gate *g, const Joint *j, int32_t i, double down, double value, double up)
{
    if (!j->bounded)
        return value;
    if (value > up || value < down)
        g->clamped[i] |= OUTWARD;
    return between(down, value, up);
}

/* Return a finite value of at most this magnitude: 0 for NaN and infinity. */
static double bounded(const Gate *g, const Joint *j, int32_t i, double value, double highest, int bit)
{
    if (isinf(value))
        g->clamped[i] |= NOT_FINITE;
    value = isfinite(value) ? value : 0.0;
    if (fabs(value) > highest) /* a velocity above the slow start's limit alone is a STEP, not TOO_FAST */
        g->clamped[i] |= (uint8_t)(bit == TOO_FAST && highest < j->highest_speed ? STEP : bit);
    return between(-highest, value, highest);
}

/* Return the goal of a joint in velocity mode, limited so that the joint stops at its position limits.
 *
 * A servo lags its goal by LAG_S, so it keeps its speed for that time after the goal has decreased. For a lag of
 * first order, the remaining distance d is replaced with d - v LAG_S. The joint then comes to rest at the limit
 * without overshoot: the characteristic polynomial is (LAG_S s + 1) (BRAKING_S s + 1). */
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
    double up = fmost(j->upper - g->position[i] - fmost(ahead, 0.0), 0.0); /* 0 if the position is NaN */
    double down = fmost(g->position[i] - j->lower + fleast(ahead, 0.0), 0.0);
    double seconds = fmost(BRAKING_S, 2e-9 * (double)dt_ns); /* a slow loop measures the distance late */
    up = g->accelerates ? braking_speed(up, seconds, j->acceleration) : up / seconds;
    down = g->accelerates ? braking_speed(down, seconds, j->acceleration) : down / seconds;
    return inward(g, j, i, -down, value, up);
}

/* Return an effort or PWM that lets a joint come to rest at its limits. Uses measured motion only, no inertia.
 *
 * A joint may approach a limit with `braking_speed`. The effort toward the limit decreases as the joint comes near
 * that speed, is 0 at that speed, and above it reverses up to the full effort, like a damper. The width of this
 * band follows the measured acceleration, so that the damper removes at most half of the excess speed in a cycle.
 * A joint beyond a limit returns to it slowly. */
static double brake(const Gate *g, Joint *j, int32_t i, double value, double highest, double dt)
{
    double velocity = number(g->velocity[i]), ends[2];
    j->rise = fmost(fabs(velocity - j->last) / dt, j->rise * fmost(0.0, 1.0 - dt / FADING_S));
    j->last = velocity;
    double band = fmost(j->least_band, 2.0 * dt * j->rise);
    for (int side = 0; side < 2; side++) {
        double sign = side ? -1.0 : 1.0, at = sign * g->position[i];
        j->fence[side] = fmost(sign * (side ? j->lower : j->upper), fleast(j->fence[side], at));
        double left = j->fence[side] - at; /* NaN if the position is not known */
        double allowed = left > 0.0 ? braking_speed(left, 2.0 * dt, j->brakes_at) : fmost(left / BRAKING_S, -j->back_speed);
        double share = between(-1.0, (allowed - sign * velocity) / band, left > 0.0 ? 1.0 : 0.0);
        ends[side] = (isnan(left) ? 0.0 : share) * highest;
    }
    return inward(g, j, i, -ends[1], value, ends[0]);
}

/* Write the effort limit of a joint in mode EFFORT_POSITION. NaN and infinity keep the last one. */
static void limit_effort(const Gate *g, const Joint *j, int32_t i)
{
    double value = fabs(g->commands[2][i]), highest = least(j->effort, LARGEST);
    if (value > highest)
        g->clamped[i] |= isinf(value) ? NOT_FINITE : TOO_STRONG;
    g->goals[2][i] = least(isfinite(value) ? value : g->goals[2][i], highest);
}

/* Move the goals of all joints toward their commands; return 1 if a clamp began in this cycle.
 *
 * Two passes: joints follow their commands exactly only if all joints can. Otherwise each joint with an
 * acceleration limit is steered. */
int32_t gate_apply(Gate *g, int64_t dt_ns)
{
    double dt = (double)(dt_ns > 1 ? dt_ns : 1) * 1e-9;
    int all_pass = 1;
    for (int32_t i = 0; i < g->count; i++) {
        Joint *j = &g->joints[i];
        int was_limp = j->limp;
        j->limp = g->torque[i] == OFF || g->torque[i] == RELEASED;
        if (was_limp && !j->limp)
            j->slow_ns = SLOW_START_NS; /* the joint holds its position, and then follows its commands slowly */
        if (was_limp || j->limp)
            stay(g, j, i);
        g->clamped[i] &= NOT_FINITE; /* set by the check of the controllers' outputs */
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
            g->clamped[i] &= NOT_FINITE; /* a limp joint ignores its commands, so no clamp applies */
            j->fence[0] = j->fence[1] = INFINITY; /* a joint that was moved past a limit by hand is not pulled back */
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
