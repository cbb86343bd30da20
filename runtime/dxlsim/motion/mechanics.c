/* Mechanics: motion of all servos of one simulation, in steps of one time grid. `mechanics.py` fills the structs.
 *
 * In each step the trajectories give the setpoints of the servos' controllers, the control law gives the torque of
 * the motors, and the plant gives the motion. All families share the law; each one uses some of its terms:
 *
 *     duty = p * error beyond the margin + punch + i * its integral + d * its speed + feed-forward + bias
 *
 * clamped to `limit`; with current control the torque is also clamped to `torque_limit`. A velocity controller is the
 * same law on the integrated speed: its I gain takes the place of P, its P gain that of D. The motor's torque is
 * `duty * stall torque - damping * velocity`.
 *
 * `motion_show` writes the motion into the registers of a servo, in ticks; `motion_take_goal` takes a new goal from them.
 *
 * Arithmetic is IEEE double in source order, built with -ffp-contract=off, so that a simulation has the same bits on
 * every machine with the same `sin`, `exp` and `pow`. NaN spreads through `least` and `most`, as in numpy.
 */

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file. mechanics.py parses the structs here, and refuses an outdated object. */
#endif
#define ARRIVED 1e-9 /* rad; distance to the goal at which a trajectory ends */
#define UNWOUND 1e-6 /* duty/s; an integral that changes the duty more slowly counts as constant */
#define LEAST_P 1e-9 /* duty per rad; bounds the integrated speed error of a velocity controller with a tiny gain */
/* Intervals at which a step is due in real time while servos move, and while they only cool, ns. Catching up after a long
 * pause of the host would delay the next reply. A sleep that ends before the next tick of a stock Linux (4 ms) sets the
 * timer of the processor, which takes some 10 us in a virtual machine. */
#define EAGER_NS 8000000
#define EASY_NS 1000000000
#define STEPS_A_LOOK 16 /* steps between two checks for rest */
#define STILL 1e-6      /* rad/s; a servo rests below it, and below UNDRIVEN */
#define UNDRIVEN 1e-8   /* rad/s, change of the speed in a step */
#define STEADY_C 1e-7   /* degrees C in a tick; a smaller change has no visible effect in years */
#define TAU 6.283185307179586
#define FREE 1e6        /* unreachable limit, as in control_law.py */
#define NEAR_TICKS 10   /* distance that counts as "in position"; the manual of the X series gives no value [i] */
#define MOST_ROUNDS 30  /* of the iteration that finds the friction of a coupling */
#define SETTLED 1e-10   /* rad/s or m/s; the iteration ends when a round changes less */
#define IN_POSITION 1   /* bits of Moving Status (123) */
#define ON_THE_WAY 2
#define RECTANGULAR 0x10
#define TRIANGULAR 0x20
#define TRAPEZOIDAL 0x30

enum { DONE, ACTION, STRAINED, STEP }; /* results of motion_step_to: `StepResult` of compiled_mechanics.py */

/* Quantities that registers show, and how positions are counted: `ShownQuantity` and `Counting` of compiled_mechanics.py */
enum { POSITION, VELOCITY, SETPOINT, SETPOINT_VELOCITY, DUTY, CURRENT, MOVING, MOVING_STATUS, TEMPERATURE, VOLTAGE, TIME };
enum { ENDLESS, JOINT, WHEEL, TURNS };
enum { UNSIGNED, TWOS_COMPLEMENT, SIGN_MAGNITUDE }; /* encodings of a register */

typedef struct { /* one servo: its command, trajectory, controller, motor and temperature; angles are the shaft's */
    double goal, speed, acceleration, turning, p_ccw, p_cw, margin_ccw, margin_cw, punch; /* ServoCommand of */
    double i, d, feed_velocity, feed_acceleration, bias, limit, torque_limit;             /* control_law.py */
    double setpoint, setpoint_velocity; /* rad and rad/s of the trajectory */
    double setpoint_change;             /* change of its velocity in the last step, rad/s */
    double stall;                       /* torque at standstill and full duty, at the supply voltage, Nm */
    double motor_damping;               /* Nm s/rad */
    double error;                       /* rad between setpoint and shaft in the last step */
    double integral;                    /* rad s */
    double torque;                      /* Nm of the motor at the speed before the last step */
    double duty;                        /* signed fraction of the supply voltage at the motor */
    double nominal_stall;               /* `stall` at the nominal voltage, Nm */
    double temperature;                 /* degrees C */
    int64_t overloaded;                 /* ticks of the strain since the beginning of the overload */
    int32_t within;                     /* 1: the duty is below its limit */
    int32_t news;                       /* 1: the temperature has changed by a degree, or an overload lasts too long */
} Servo;

typedef struct { /* one shaft with its motor and load, as PlantJoint of plant.py */
    double inertia;                       /* kg m^2 of motor and load */
    double damping, viscous_friction;     /* Nm s/rad: of the motor with its viscous friction; the latter alone */
    double friction, load_friction;       /* Nm; Nm per Nm of torque between motor and load */
    double gravity, down, turns, steady;  /* Nm; rad where the load hangs; load turns per turn; Nm */
    double stribeck[3];                   /* Nm, rad/s, exponent; 0 Nm: none */
    int64_t coupled;                      /* 1: a Coupling moves it */
} Joint;

typedef struct { /* servos that move joints together, in coordinates s and q: coupled_joints.py has the equation */
    int64_t servos, joints;
    const int64_t *index;             /* of each servo in the mechanics */
    double *reference;                /* rad of the shaft at s = 0 */
    const double *per_rad;            /* s per rad of the shaft */
    const double *rows;               /* directions of friction: each servo's own, then each joint's, the matrix M */
    const double *stiffness, *loads;  /* servos x servos: N' K N and M' J_q M */
    const double *rotors, *own_damping, *viscous; /* of each servo */
    const double *friction, *load_friction, *stribeck, *jammed; /* of each servo; `stribeck` at its shaft */
    const double *gravity, *down, *steady, *joint_friction;     /* of each joint */
    double *braking;                  /* damping of the servos for which the matrices below hold */
    double *mass, *inverse;           /* servos x servos */
    double *answers, *gains;          /* change of s' and of the speed along each row by an impulse along each row */
    double *work;                     /* room for 5 * servos + 4 * (servos + joints) numbers */
    double dt;                        /* step for which the matrices hold, s; 0: none */
} Coupling;

typedef struct { /* new goal of a servo, which takes effect later */
    int64_t t_ns, order, index;
    double goal, speed, acceleration;
} Aim;

typedef struct {
    Servo *servos;
    Joint *joints;          /* NULL: Python steps the plant */
    Coupling *couplings;    /* of some of the joints */
    int64_t coupling_count;
    double *angle, *velocity; /* of the plant, rad and rad/s */
    double *before;         /* velocities before the last step */
    double *drive, *damping; /* torque of the servos for the plant: drive - damping * velocity; Nm, Nm s/rad */
    int64_t count;          /* number of servos */
    int64_t step_ns, strain_step_ns;  /* steps of the grid and of the strain */
    int64_t start_ns, grid_ns;        /* time of the first and the last step */
    int64_t strain_ns, agenda_ns;     /* next time of the strain, and of an action of Python; INT64_MAX: none */
    double step_s, strain_part;       /* `step_ns` in s; a tick of the strain as a fraction of its time constant */
    double ambient_c, stalled_rise_c; /* degrees C: see mechanics.py */
    double overload_part;             /* fraction of the torque allowed by the limit, above it is an overload */
    int64_t overload_ticks;           /* tolerated duration of an overload */
    Aim *aims;              /* in the order of their times */
    int64_t aim_count, aim_room;
    int64_t order, agenda_order; /* number of the next action or aim, and of the next action of Python */
    int32_t hands;          /* number of shafts that are turned by hand, which Python does */
    int32_t busy;           /* 1: Python acts, and may read the time but not advance it */
    int32_t still;          /* 1: all servos rest without new commands */
    int32_t arrived;        /* 1: no trajectory moves */
    int32_t calm;           /* 1: the same load would change no temperature any more */
    int32_t news;           /* 1: a servo has `news` */
} Mechanics;

typedef struct { /* register that shows a quantity, rounded to ticks */
    double times, unit;            /* ticks = quantity * times / unit */
    int64_t zero, lowest, highest; /* ticks at 0, and the range of the register */
    int32_t quantity, address, size;
    int32_t sign_bit;              /* bit of a negative sign, which limits the magnitude to `highest`; -1: none */
} LiveItem;

typedef struct { /* register of a goal; size 0: the model lacks it */
    int32_t address, size, encoding, unused;
} GoalItem;

typedef struct { /* shaft of one servo, as its registers show it */
    Mechanics *mechanics;
    uint8_t *memory;               /* registers */
    const LiveItem *items;
    int64_t item_count, index;     /* `index`: of the servo in the mechanics */
    int64_t now_ns, started_ns;    /* time of the servo, and of its start */
    int64_t offset, highest_tick;  /* ticks: of the position, and its end in joint and wheel mode */
    double sign;                   /* -1: clockwise is positive */
    double rad_per_tick, divider;  /* of the position, and of TURNS alone */
    double noticed_speed;          /* rad/s from which the shaft counts as moving */
    double torque_per_ampere;      /* Nm/A */
    double voltage, supply_ohm;    /* V of the supply without load, and the resistance of its cable */
    GoalItem goal_items[3];        /* position, speed and acceleration of the trajectory */
    int64_t aimed[3];              /* their values for the current trajectory */
    int64_t response_delay_ns;     /* delay until a goal takes effect */
    double speed_unit, acceleration_unit; /* rad/s and rad/s^2 per tick */
    double turns_apart;            /* whole turns between the shaft's angle and the turn of joint mode, rad */
    double next[3];                /* new trajectory: goal, speed, acceleration */
    int32_t time_based;            /* 1: speed and acceleration are durations in ms */
    int32_t counting;
    int32_t goes_to_goal, turns;   /* 1: the command has a goal; 1: it has a speed */
    int32_t profile_kind;          /* bits of Moving Status */
} Shaft;

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

static double clamp(double value, double limit)
{
    return most(least(value, limit), -limit);
}

/* Advance a trajectory by one step.
 *
 * The speed is limited by the profile's speed, and changes with the profile's acceleration (e-Manual, X series, Profile
 * Velocity (112)). The manual's jerk control is not modelled. A new goal starts with the current velocity of the
 * trajectory ("Velocity Override"). */
static void follow(Servo *s, double dt)
{
    double error = s->goal - s->setpoint, way = fabs(error), ramp = s->acceleration * dt;
    /* Braking by a dt in each of n steps from v takes n v - n (n - 1) / 2 a dt, in steps of dt. Choose the least n with
     * which the rest of the way can end at rest, and the v that ends exactly there. */
    double steps = most(ceil((sqrt(way * (8 / (ramp * dt)) + 1.0) - 1.0) * 0.5), 1.0);
    double speed = (steps - 1.0) * (ramp / 2) + way * (1.0 / dt) / steps;
    speed = s->turning != 0.0 ? s->speed : copysign(least(speed, s->speed), error);
    s->setpoint_change = clamp(speed - s->setpoint_velocity, ramp);
    s->setpoint_velocity += s->setpoint_change;
    s->setpoint += s->setpoint_velocity * dt;
}

/* Compute the torque of a servo for its setpoint and the shaft's angle and velocity. */
static void control(Servo *s, double angle, double velocity, double dt, double *drive, double *damping)
{
    double error = s->setpoint - angle;
    if (s->turning != 0.0) {
        /* Anti-windup: the integrated speed error stops at the value that requires the full limit. */
        if (s->p_ccw > 0.0)
            error = clamp(error, s->limit / most(s->p_ccw, LEAST_P));
        s->setpoint = angle + error;
    }
    int ccw = error > 0.0;
    double beyond = fabs(error) - (ccw ? s->margin_ccw : s->margin_cw);
    double wanted = most(beyond, 0.0) * (ccw ? s->p_ccw : s->p_cw) + (beyond > 0.0 ? s->punch : 0.0);
    wanted = copysign(wanted, error) + (s->d + s->feed_velocity) * s->setpoint_velocity + s->bias;
    wanted = wanted + s->feed_acceleration * s->setpoint_change / dt + s->i * s->integral;
    double undamped = wanted;
    wanted = undamped - s->d * velocity;
    s->duty = clamp(wanted, s->limit);
    s->error = error;
    s->within = wanted == s->duty;
    /* At the limit the controller's own damping has no effect. Elsewhere the plant applies it. */
    *drive = (s->within ? undamped : s->duty) * s->stall;
    *damping = (s->within ? s->d * s->stall : 0.0) + s->motor_damping;
    if (s->i != 0.0 && s->within)
        s->integral += error * dt;
    s->torque = *drive - *damping * velocity;
    if (fabs(s->torque) > s->torque_limit) { /* only for a motor whose current is controlled */
        *drive = s->torque = clamp(s->torque, s->torque_limit);
        *damping = 0.0;
    }
}

/* Additional friction near standstill, Nm (Stribeck effect). */
static double near_standstill(const double stribeck[3], double velocity)
{
    return stribeck[0] * exp(-pow(fabs(velocity) / stribeck[1], stribeck[2]));
}

static double dot(const double *a, const double *b, int64_t count, int64_t stride)
{
    double sum = 0.0;
    for (int64_t i = 0; i < count; i++)
        sum += a[i] * b[i * stride];
    return sum;
}

/* Replace a positive definite matrix, whose `inverse` begins as the unit matrix, by Gauss-Jordan elimination. */
static void invert(double *matrix, double *inverse, int64_t size)
{
    for (int64_t at = 0; at < size; at++) {
        double pivot = matrix[at * size + at];
        for (int64_t k = 0; k < size; k++) {
            matrix[at * size + k] /= pivot;
            inverse[at * size + k] /= pivot;
        }
        for (int64_t i = 0; i < size; i++) {
            double by = matrix[i * size + at];
            for (int64_t k = 0; i != at && k < size; k++) {
                matrix[i * size + k] -= by * matrix[at * size + k];
                inverse[i * size + k] -= by * inverse[at * size + k];
            }
        }
    }
}

/* Prepare the matrices of a coupling for a damping of its servos and a step. */
static void take_braking(Coupling *c, const double *braking, double dt)
{
    int64_t n = c->servos, all = n + c->joints;
    double *stepped = c->gains; /* free until the last lines */
    c->dt = dt;
    for (int64_t i = 0; i < n; i++) {
        c->braking[i] = braking[i];
        for (int64_t k = 0; k < n; k++) {
            int64_t at = i * n + k;
            c->inverse[at] = i == k;
            c->mass[at] = c->loads[at];
            /* As of single joints: subtract half a step of damping, but keep at least half of the inertia. */
            if (i == k)
                c->mass[at] += most(c->rotors[i] - c->own_damping[i] * dt / 2, c->rotors[i] / 2);
            stepped[at] = c->mass[at] + c->stiffness[at] * (dt * dt);
            if (i == k)
                stepped[at] += (braking[i] + c->viscous[i]) * dt;
        }
    }
    invert(stepped, c->inverse, n);
    for (int64_t i = 0; i < n; i++)
        for (int64_t row = 0; row < all; row++)
            c->answers[i * all + row] = dot(c->inverse + i * n, c->rows + row * n, n, 1);
    for (int64_t row = 0; row < all; row++)
        for (int64_t other = 0; other < all; other++)
            c->gains[row * all + other] = dot(c->rows + row * n, c->answers + other, n, all);
}

/* Find the impulses `held` of friction along each row by iteration (projected Gauss-Seidel), given the speeds without
 * friction and the largest impulses. */
static void rub(const Coupling *c, double *speeds, const double *bounds, double *held)
{
    int64_t all = c->servos + c->joints;
    for (int64_t row = 0; row < all; row++)
        held[row] = 0.0;
    for (int32_t round = 0; round < MOST_ROUNDS; round++) {
        double change = 0.0;
        for (int64_t row = 0; row < all; row++) {
            const double *gains = c->gains + row * all;
            double impulse = clamp(held[row] - speeds[row] / gains[row], bounds[row]), by = impulse - held[row];
            if (!(bounds[row] > 0.0) || by == 0.0)
                continue;
            held[row] = impulse;
            for (int64_t other = 0; other < all; other++)
                speeds[other] += gains[other] * by;
            change = most(change, fabs(by) * gains[row]);
        }
        if (change < SETTLED)
            return;
    }
}

/* Advance the servos of a coupling. Damping and the elasticity of brackets are implicit (backward Euler), so a step is
 * stable at any stiffness. */
static void step_coupling(Coupling *c, double *angle, double *velocity, const double *drive, const double *damping,
                          double dt)
{
    int64_t n = c->servos, all = n + c->joints;
    double *place = c->work, *speed = place + n, *torque = speed + n, *braking = torque + n, *pull = braking + n;
    double *weight = pull + n, *bounds = weight + all, *speeds = bounds + all, *held = speeds + all;
    int changed = dt != c->dt;
    for (int64_t i = 0; i < n; i++) {
        int64_t at = c->index[i];
        place[i] = c->per_rad[i] * (angle[at] - c->reference[i]);
        speed[i] = c->per_rad[i] * velocity[at];
        torque[i] = drive[at] / c->per_rad[i];
        braking[i] = damping[at] / (c->per_rad[i] * c->per_rad[i]);
        changed |= braking[i] != c->braking[i];
    }
    for (int64_t j = 0; j < c->joints; j++) {
        double q = dot(c->rows + (n + j) * n, place, n, 1);
        weight[j] = c->gravity[j] * sin(q - c->down[j]) + c->steady[j];
        bounds[n + j] = c->joint_friction[j] * dt;
    }
    for (int64_t i = 0; i < n; i++)
        pull[i] = dot(weight, c->rows + n * n + i, c->joints, n) + dot(c->stiffness + i * n, place, n, 1);
    if (changed)
        take_braking(c, braking, dt);
    for (int64_t i = 0; i < n; i++) {
        double holds = c->friction[i] + c->load_friction[i] * fabs(torque[i] - braking[i] * speed[i] + pull[i]);
        if (c->stribeck[3 * i] != 0.0)
            holds += near_standstill(c->stribeck + 3 * i, velocity[c->index[i]]) / fabs(c->per_rad[i]);
        bounds[i] = (holds + c->jammed[i]) * dt;
    }
    double *impulse = place, *free = pull; /* both are used up */
    for (int64_t i = 0; i < n; i++)
        impulse[i] = dot(c->mass + i * n, speed, n, 1) + dt * (torque[i] - pull[i]);
    for (int64_t i = 0; i < n; i++)
        free[i] = dot(c->inverse + i * n, impulse, n, 1);
    for (int64_t row = 0; row < all; row++)
        speeds[row] = dot(c->rows + row * n, free, n, 1);
    rub(c, speeds, bounds, held);
    for (int64_t i = 0; i < n; i++) {
        int64_t at = c->index[i];
        velocity[at] = (free[i] + dot(c->answers + i * all, held, all, 1)) / c->per_rad[i];
        angle[at] += velocity[at] * dt;
    }
}

/* Advance shafts by `dt` s with servo torque `drive - damping * velocity`: those that do not affect each other here.
 *
 * The velocity is updated first, with implicit damping: stable at any damping and any step. That alone would brake less
 * than the motor does, as if dt / 2 of its damping were inertia (7 % for an MX-64). Subtracting this from the inertia
 * turns the step into Crank-Nicolson's. At least half of the inertia is kept: the correction does not improve a step as
 * long as the motor's time constant. */
void motion_step_joints(const Joint *joints, Coupling *couplings, int64_t coupling_count, double *angle,
                        double *velocity, const double *drive, const double *damping, int64_t count, double dt)
{
    for (int64_t i = 0; i < coupling_count; i++)
        step_coupling(&couplings[i], angle, velocity, drive, damping, dt);
    for (int64_t i = 0; i < count; i++) {
        const Joint *j = &joints[i];
        if (j->coupled)
            continue;
        double per_torque = dt / most(j->inertia - j->damping * dt / 2, j->inertia / 2);
        double pull = j->steady;
        if (j->gravity != 0.0)
            pull = sin((angle[i] - j->down) * j->turns) * j->gravity + j->steady;
        /* The torque between motor and load, which load friction depends on. */
        double holds = fabs(drive[i] - damping[i] * velocity[i] + pull) * (j->load_friction * per_torque);
        holds += j->friction * per_torque;
        if (j->stribeck[0] != 0.0)
            holds += near_standstill(j->stribeck, velocity[i]) * per_torque;
        double free = velocity[i] + (drive[i] - pull) * per_torque; /* velocity without friction and damping */
        /* Friction removes at most the whole velocity: a joint that it stops stays at rest. */
        double rubbed = free - clamp(free, holds);
        velocity[i] = rubbed / (per_torque * damping[i] + (1.0 + j->viscous_friction * per_torque));
        angle[i] += velocity[i] * dt;
    }
}

/* First half of a step: advance the trajectories, and compute the torques of the servos. */
void motion_drive(Mechanics *m)
{
    for (int64_t i = 0; i < m->count; i++) {
        Servo *s = &m->servos[i];
        m->before[i] = m->velocity[i];
        if (!m->arrived)
            follow(s, m->step_s);
        control(s, m->angle[i], m->velocity[i], m->step_s, &m->drive[i], &m->damping[i]);
    }
}

/* Return true if a trajectory has ended; with a speed command, if that speed is reached. */
static int at_goal(const Servo *s)
{
    return s->turning != 0.0 ? s->setpoint_velocity == s->speed : fabs(s->goal - s->setpoint) < ARRIVED;
}

/* Set trajectories exactly to their goals, and stop stepping them, if all have ended. */
static void check_arrival(Mechanics *m)
{
    for (int64_t i = 0; i < m->count; i++) {
        const Servo *s = &m->servos[i];
        if (s->turning != 0.0 || !at_goal(s) || !(fabs(s->setpoint_velocity) < ARRIVED / m->step_s))
            return;
    }
    for (int64_t i = 0; i < m->count; i++) {
        Servo *s = &m->servos[i];
        s->setpoint = s->goal;
        s->setpoint_velocity = s->setpoint_change = 0.0;
    }
    m->arrived = 1;
}

/* After the plant's half of a step: mark the servos as still if they all rest. A check in every step would cost more
 * than the steps that it saves. */
void motion_check_rest(Mechanics *m)
{
    if ((m->grid_ns - m->start_ns) / m->step_ns % STEPS_A_LOOK)
        return;
    if (!m->arrived)
        check_arrival(m);
    if (!m->arrived)
        return;
    for (int64_t i = 0; i < m->count; i++) {
        const Servo *s = &m->servos[i];
        /* An integral that changes may still move a shaft that friction holds. */
        int winds = s->within && fabs(s->i * s->error) > UNWOUND;
        double velocity = m->velocity[i];
        if (winds || !(fabs(velocity) < STILL) || !(fabs(m->before[i] - velocity) < UNDRIVEN))
            return;
    }
    for (int64_t i = 0; i < m->count; i++)
        m->velocity[i] = 0.0;
    m->still = 1;
}

/* Update temperatures and overloads. A temperature follows the copper loss: current squared, housing and winding as one
 * body [i]. */
static void strain(Mechanics *m)
{
    m->calm = 1;
    for (int64_t i = 0; i < m->count; i++) {
        Servo *s = &m->servos[i];
        double shown = rint(s->temperature), load = s->torque / s->nominal_stall;
        double change = (m->ambient_c + m->stalled_rise_c * load * load - s->temperature) * m->strain_part;
        double allowed = s->stall * s->limit; /* at standstill, by duty limit and supply */
        int too_much = fabs(s->torque) >= m->overload_part * allowed && allowed > 0.0;
        s->temperature += change;
        s->overloaded = too_much ? s->overloaded + 1 : 0;
        if (too_much || !(fabs(change) < STEADY_C))
            m->calm = 0;
        if (rint(s->temperature) != shown || s->overloaded == m->overload_ticks)
            m->news = s->news = 1;
    }
}

static void end_step(Mechanics *m, int64_t steps)
{
    m->grid_ns += steps * m->step_ns;
    if (m->grid_ns < m->strain_ns)
        return;
    m->strain_ns = m->grid_ns - (m->grid_ns - m->start_ns) % m->strain_step_ns + m->strain_step_ns;
    if (m->count)
        strain(m);
}

/* Last part of a step whose plant Python has stepped. */
void motion_end_step(Mechanics *m)
{
    end_step(m, 1);
}

/* Time of the next action or aim; INT64_MAX: none. */
static int64_t next_action(const Mechanics *m)
{
    return m->aim_count && m->aims[0].t_ns < m->agenda_ns ? m->aims[0].t_ns : m->agenda_ns;
}

/* Time at which a step is due in real time, even without requests of hosts; INT64_MAX: nothing moves or cools. */
int64_t motion_next_step(const Mechanics *m)
{
    int64_t action_ns = next_action(m), easy_ns = m->grid_ns + EASY_NS;
    if (!m->count)
        return INT64_MAX;
    if (!m->still)
        return m->grid_ns + EAGER_NS;
    if (action_ns != INT64_MAX) { /* it is done by the step after the first point of the grid at or after its time */
        int64_t steps = action_ns > m->grid_ns ? (action_ns - m->grid_ns + m->step_ns - 1) / m->step_ns : 0;
        action_ns = m->grid_ns + (steps + 1) * m->step_ns;
    }
    return m->calm || action_ns < easy_ns ? action_ns : easy_ns;
}

/* Change only a servo's goal, rad, and the speed, rad/s, and acceleration, rad/s^2, of its trajectory. */
void motion_aim(Mechanics *m, int64_t index, double goal, double speed, double acceleration)
{
    Servo *s = &m->servos[index];
    s->goal = goal;
    s->speed = speed;
    s->acceleration = acceleration;
    m->calm = m->still = m->arrived = 0;
}

/* Do the aims that are due before the next action of Python. */
static void do_aims(Mechanics *m)
{
    int64_t done = 0;
    for (; done < m->aim_count; done++) {
        const Aim *a = &m->aims[done];
        int later = a->t_ns > m->agenda_ns || (a->t_ns == m->agenda_ns && a->order > m->agenda_order);
        if (a->t_ns > m->grid_ns || later)
            break;
        motion_aim(m, a->index, a->goal, a->speed, a->acceleration);
    }
    if (done) {
        m->aim_count -= done;
        memmove(m->aims, m->aims + done, (size_t)m->aim_count * sizeof(Aim));
    }
}

/* Withdraw the aims of a servo that have not taken effect. */
void motion_withdraw(Mechanics *m, int64_t index)
{
    int64_t kept = 0;
    for (int64_t i = 0; i < m->aim_count; i++)
        if (m->aims[i].index != index)
            m->aims[kept++] = m->aims[i];
    m->aim_count = kept;
}

/* Number of steps to skip while all servos rest: up to the next action or change of temperature. */
static int64_t resting_steps(const Mechanics *m, int64_t now_ns)
{
    int64_t action_ns = next_action(m), until_ns = action_ns < now_ns ? action_ns : now_ns;
    if (!m->calm && m->strain_ns < until_ns)
        until_ns = m->strain_ns;
    int64_t steps = (until_ns - m->grid_ns) / m->step_ns;
    return steps > 1 ? steps : 1;
}

/* Step all servos up to the last grid point at or before `now_ns`. Returns earlier where Python has to act: an action
 * is due, a servo has news, or Python takes a step. Then the same call continues after it. */
int32_t motion_step_to(Mechanics *m, int64_t now_ns)
{
    if (m->busy)
        return DONE;
    if (m->news)
        return STRAINED;
    while (m->grid_ns + m->step_ns <= now_ns) {
        do_aims(m);
        if (m->agenda_ns <= m->grid_ns)
            return ACTION;
        if (m->still || !m->count)
            end_step(m, resting_steps(m, now_ns));
        else if (!m->joints || m->hands)
            return STEP;
        else {
            motion_drive(m);
            motion_step_joints(m->joints, m->couplings, m->coupling_count, m->angle, m->velocity, m->drive, m->damping,
                               m->count, m->step_s);
            motion_check_rest(m);
            end_step(m, 1);
        }
        if (m->news)
            return STRAINED;
    }
    return DONE;
}

/* Angle of the shaft at the servo's time, rad from raw 0, including turns, without Homing Offset and reversal. */
double motion_angle(const Shaft *s)
{
    const Mechanics *m = s->mechanics;
    int64_t ahead_ns = s->now_ns - m->grid_ns;
    double angle = m->angle[s->index];
    return ahead_ns > 0 ? angle + m->velocity[s->index] * (double)ahead_ns * 1e-9 : angle;
}

static double setpoint_velocity(const Shaft *s)
{
    return s->goes_to_goal || s->turns ? s->mechanics->servos[s->index].setpoint_velocity : 0.0;
}

static double setpoint(const Shaft *s)
{
    int64_t ahead_ns = s->now_ns - s->mechanics->grid_ns;
    if (!s->goes_to_goal)
        return motion_angle(s);
    return s->mechanics->servos[s->index].setpoint + setpoint_velocity(s) * ((double)(ahead_ns > 0 ? ahead_ns : 0) * 1e-9);
}

static int is_under_way(const Shaft *s)
{
    return s->goes_to_goal && !at_goal(&s->mechanics->servos[s->index]);
}

/* Return 1 while the shaft's trajectory moves, or while its speed exceeds the threshold. */
int32_t motion_is_moving(const Shaft *s)
{
    return is_under_way(s) || fabs(s->mechanics->velocity[s->index]) > s->noticed_speed;
}

static int32_t moving_status(const Shaft *s)
{
    if (!s->goes_to_goal)
        return motion_is_moving(s) ? 0 : IN_POSITION;
    if (is_under_way(s))
        return s->profile_kind | ON_THE_WAY;
    double left = fabs(s->mechanics->servos[s->index].setpoint - motion_angle(s));
    return s->profile_kind | (left <= NEAR_TICKS * s->rad_per_tick ? IN_POSITION : 0);
}

/* Return the whole turns in an angle, rad; an angle slightly outside the range of joint mode counts as inside. */
double motion_whole_turns(const Shaft *s, double angle)
{
    double outside = most(TAU - (double)s->highest_tick * s->rad_per_tick, 0.1) / 2;
    return TAU * floor((angle + outside) / TAU);
}

static double in_turn(double angle)
{
    if (angle >= 0.0 && angle < TAU)
        return angle;
    double left = fmod(angle, TAU);
    return left < 0.0 ? left + TAU : left;
}

/* Return the value of Present Position for an angle of the shaft, rad. Beyond the range of joint mode it is the nearest
 * end [i]. */
double motion_position_tick(const Shaft *s, double angle)
{
    double highest = (double)s->highest_tick, offset = (double)s->offset;
    if (s->counting == ENDLESS)
        return rint(s->sign * angle / s->rad_per_tick) + offset;
    if (s->counting == TURNS) { /* in two's complement */
        double tick = fmod(rint(angle / s->rad_per_tick / s->divider) + offset, 65536.0);
        return tick < 0.0 ? tick + 65536.0 : tick;
    }
    if (s->counting == WHEEL)
        angle = in_turn(angle);
    else if (angle > TAU || angle < -1.0)
        angle = in_turn(angle - motion_whole_turns(s, angle));
    double tick = rint(angle / s->rad_per_tick);
    if (s->counting == WHEEL && tick > highest) /* in the dead zone */
        return tick - highest < (TAU / s->rad_per_tick - highest) / 2 ? highest : 0.0;
    return most(least(tick, highest), 0.0);
}

static double quantity(const Shaft *s, int32_t which)
{
    const Mechanics *m = s->mechanics;
    const Servo *servo = &m->servos[s->index];
    double current = servo->torque / s->torque_per_ampere; /* A, positive when it drives counter-clockwise */
    switch (which) {
    case VELOCITY: return s->sign * m->velocity[s->index];
    case SETPOINT_VELOCITY: return s->sign * setpoint_velocity(s);
    case DUTY: return s->sign * servo->duty;
    case CURRENT: return s->sign * current;
    case MOVING: return motion_is_moving(s);
    case MOVING_STATUS: return moving_status(s);
    case TEMPERATURE: return servo->temperature;
    case VOLTAGE: return s->voltage - s->supply_ohm * fabs(servo->duty * current);
    default: return (double)((s->now_ns - s->started_ns) / 1000000 % 32768); /* ms */
    }
}

static int64_t shown(const Shaft *s, const LiveItem *item)
{
    double ticks;
    if (item->quantity == POSITION || item->quantity == SETPOINT)
        ticks = motion_position_tick(s, item->quantity == POSITION ? motion_angle(s) : setpoint(s));
    else
        ticks = rint(quantity(s, item->quantity) * item->times / item->unit) + (double)item->zero;
    double highest = (double)item->highest;
    if (item->sign_bit >= 0) {
        int64_t magnitude = (int64_t)least(fabs(ticks), highest);
        return ticks < 0.0 && magnitude ? magnitude | (int64_t)1 << item->sign_bit : magnitude;
    }
    return (int64_t)most(least(ticks, highest), (double)item->lowest);
}

/* Write the motion at `now_ns` into those registers that show it and have a byte in a range of addresses. The mechanics
 * must have been stepped to this time. */
void motion_show(Shaft *s, int64_t now_ns, int32_t address, int32_t length)
{
    if (now_ns > s->now_ns)
        s->now_ns = now_ns;
    for (int64_t i = 0; i < s->item_count; i++) {
        const LiveItem *item = &s->items[i];
        if (item->address >= address + length || address >= item->address + item->size)
            continue;
        int64_t value = shown(s, item);
        for (int32_t byte = 0; byte < item->size; byte++)
            s->memory[item->address + byte] = (uint8_t)(value >> 8 * byte);
    }
}

static int64_t goal_value(const Shaft *s, int32_t which)
{
    const GoalItem *item = &s->goal_items[which];
    int64_t value = 0;
    for (int32_t i = 0; i < item->size; i++)
        value |= (int64_t)s->memory[item->address + i] << 8 * i;
    if (item->encoding == TWOS_COMPLEMENT && item->size && value >> (8 * item->size - 1))
        value -= (int64_t)1 << 8 * item->size;
    if (which) /* of speed and acceleration only the magnitude counts */
        value = item->encoding == SIGN_MAGNITUDE ? value & 1023 : value < 0 ? -value : value;
    return value;
}

static int32_t kind_of_profile(double ramp, double distance, double speed, double acceleration)
{
    if (ramp == 0.0)
        return RECTANGULAR;
    return distance * acceleration > speed * speed ? TRAPEZOIDAL : TRIANGULAR;
}

/* Trajectory of a move with a duration and an acceleration time, s; the latter is at most half as long. */
static void plan_timed(Shaft *s, double distance, double duration, double ramp)
{
    if (distance == 0.0)
        return;
    ramp = least(ramp, duration / 2);
    s->next[1] = distance / (duration - ramp);
    s->next[2] = ramp != 0.0 ? s->next[1] / ramp : FREE;
    s->profile_kind = kind_of_profile(ramp, distance, s->next[1], s->next[2]);
}

/* Trajectory of servos with a profile: Profile Velocity 0 disables it (a step), Profile Acceleration 0 makes it
 * rectangular (e-Manual, X series, Profile Velocity (112)). */
static void plan_profile(Shaft *s, double velocity, double ramp)
{
    s->next[0] = s->sign * (double)(s->aimed[0] - s->offset) * s->rad_per_tick;
    double distance = fabs(s->next[0] - s->mechanics->servos[s->index].setpoint);
    if (velocity == 0.0)
        s->profile_kind = 0;
    else if (s->time_based)
        plan_timed(s, distance, velocity * 1e-3, ramp * 1e-3);
    else {
        s->next[1] = velocity * s->speed_unit;
        s->next[2] = ramp != 0.0 ? ramp * s->acceleration_unit : FREE;
        s->profile_kind = kind_of_profile(ramp, distance, s->next[1], s->next[2]);
    }
}

/* Plan the trajectory that the registers ask for as `next`. Return 0 if it has not changed, unless `afresh`. */
int32_t motion_plan(Shaft *s, int32_t afresh)
{
    int64_t aimed[3] = {goal_value(s, 0), goal_value(s, 1), goal_value(s, 2)};
    double velocity = (double)aimed[1], ramp = (double)aimed[2];
    if (!afresh && !memcmp(aimed, s->aimed, sizeof aimed))
        return 0;
    if (afresh && s->counting != ENDLESS)
        s->turns_apart = motion_whole_turns(s, motion_angle(s));
    memcpy(s->aimed, aimed, sizeof aimed);
    s->next[1] = s->next[2] = FREE;
    if (s->counting == ENDLESS) {
        plan_profile(s, velocity, ramp);
        return 1;
    }
    if (s->counting == TURNS) { /* the goal is in two's complement */
        double signed_goal = (double)(aimed[0] - (aimed[0] >> 15 << 16));
        s->next[0] = (signed_goal - (double)s->offset) * s->divider * s->rad_per_tick;
    } else
        s->next[0] = (double)aimed[0] * s->rad_per_tick + s->turns_apart;
    if (velocity != 0.0) /* 0: no limit */
        s->next[1] = velocity * s->speed_unit;
    if (ramp != 0.0)
        s->next[2] = ramp * s->acceleration_unit;
    return 1;
}

/* Let the planned trajectory take effect after the response delay, at the next point of the grid. Return 0 without room
 * for another aim.
 *
 * It is up to a step late, half a step on average. That compensates the lead of a plant, which updates its velocity
 * first. */
int32_t motion_follow(Shaft *s)
{
    Mechanics *m = s->mechanics;
    int64_t at = m->aim_count;
    Aim aim = {s->now_ns + s->response_delay_ns, m->order, s->index, s->next[0], s->next[1], s->next[2]};
    if (at == m->aim_room)
        return 0;
    m->order++;
    m->aim_count++;
    for (; at && m->aims[at - 1].t_ns > aim.t_ns; at--)
        m->aims[at] = m->aims[at - 1];
    m->aims[at] = aim;
    return 1;
}

/* Follow goals at `now_ns` that were written into the registers. Return 0 if Python must do it: the servo does not
 * control a position, or there is no room for another aim. */
int32_t motion_take_goal(Shaft *s, int64_t now_ns)
{
    if (!s->goes_to_goal || s->mechanics->aim_count == s->mechanics->aim_room)
        return 0;
    if (now_ns > s->now_ns)
        s->now_ns = now_ns;
    if (motion_plan(s, 0))
        motion_follow(s);
    return 1;
}
