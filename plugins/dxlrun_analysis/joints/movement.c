/* Movement of joints: one pass over the cycles of each joint, instead of many over columns. `movement.py` fills the
 * structs. Columns have shape (joints, cycles).
 */

#include <float.h>
#include <math.h>
#include <stdint.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: movement.py rejects an object of another version */
#endif

#define JUMP_S 0.5      /* positions further apart are not compared: the joint may have been moved by hand */
#define TOO_FAST 1.25   /* a supply at its limit and a pulling load make a servo slightly faster than its model */
#define SWING_RAD 0.035 /* 2 deg: smallest swing that counts */
#define FULL_SPEED 0.8  /* a joint moves as fast as it can from this share of its greatest speed so far on */
#define SLOWEST_TOP 0.4 /* share of the model's top speed that a joint reaches with a weak supply and a load */

enum { ERROR, WAY, POSITION, SPEED, LOAD, AWAY, SWINGS, GOALS, QUANTITIES }; /* in the order of failing.py */

typedef struct {
    const int64_t *read_ns, *age_ns, *bin; /* `bin` of each cycle */
    const double *steps;                   /* s between two cycles */
    const uint8_t *torque, *valid;
    const double *position, *velocity, *effort, *goal_position, *goal_effort, *way, *reference;
    int64_t count, known; /* cycles; those at the begin that are used for speeds only */
    double rate;          /* cycles a second */
    int64_t torque_on;
} Cycles;

typedef struct { /* columns of shape (joints,) */
    const double *share, *top_speed; /* top speed of the model; 0 if unknown */
    const double *turn_speed;        /* the same; NaN if unknown, or if the position jumps once per turn */
    const double *least_jump;        /* shorter distances are no jumps */
    const int64_t *reference;        /* row in the reference; -1 without one */
    double *fastest;
    int64_t count;
} Joints;

typedef struct { /* columns of `Jumps` */
    int64_t *number, *first_ns, *read_ns;
    double *longest, *position;
} Jumps;

typedef struct { /* shape (quantities, bins, joints) */
    double *least, *most, *total, *count;
    int64_t bins;
} Bins;

typedef struct { /* overwritten; cycles without the known ones */
    double *values;            /* shape (quantities, cycles) */
    double *off, *led, *marks; /* shape (cycles,) */
    double *free;              /* position with torque and position control, shape (joints, cycles) */
} Scratch;

uint32_t dxl_source(void)
{
    return SOURCE_CRC;
}

/* A log can contain any times, so differences of times wrap. */
static int64_t minus(int64_t a, int64_t b)
{
    return (int64_t)((uint64_t)a - (uint64_t)b);
}

static double larger(double a, double b)
{
    return a > b ? a : b;
}

/* Add the rate to `marks` where a swing of finite values ends: two reversals that are `least` apart or more, without
 * missing values in between. */
static void mark_swings(const double *values, int64_t count, double least, double rate, double *marks)
{
    int64_t before = -1, rank = 0, end = -1, end_rank = 0, turn = -1, turn_rank = 0;
    double last_step = 0.0;
    for (int64_t at = 0; at < count; at++) {
        if (!isfinite(values[at])) {
            continue;
        }
        double step = before < 0 ? 0.0 : values[at] - values[before];
        if (step != 0.0) {
            if (step * last_step < 0.0) {
                if (turn >= 0 && fabs(values[end] - values[turn]) >= least && end - turn == end_rank - turn_rank) {
                    marks[end] = rate;
                }
                turn = end, turn_rank = end_rank;
            }
            last_step = step, end = at, end_rank = rank;
        }
        before = at, rank++;
    }
}

/* Compare a position and its time with the one before. */
static void add_position(const Joints *joints, const Jumps *jumps, int64_t joint, int64_t at_ns, double position)
{
    double seconds = (double)minus(at_ns, jumps->read_ns[joint]) * 1e-9, speed = joints->turn_speed[joint];
    double moved = fabs(position - jumps->position[joint]);
    if (!isnan(speed) && moved > larger(joints->least_jump[joint], TOO_FAST * speed * seconds) && seconds < JUMP_S) {
        jumps->first_ns[joint] = jumps->first_ns[joint] ? jumps->first_ns[joint] : at_ns;
        jumps->longest[joint] = larger(jumps->longest[joint], moved);
        jumps->number[joint]++;
    }
    jumps->read_ns[joint] = at_ns, jumps->position[joint] = position;
}

static void add_to_bins(
    const Bins *bins, int64_t joints, int64_t joint, const int64_t *bin, const double *values, int64_t count)
{
    for (int64_t begin = 0, end; begin < count; begin = end) {
        for (end = begin + 1; end < count && bin[end] == bin[begin]; end++) {
        }
        for (int64_t quantity = 0; quantity < QUANTITIES; quantity++) {
            const double *mine = values + quantity * count;
            int64_t at = (quantity * bins->bins + bin[begin]) * joints + joint, known = 0;
            double least = bins->least[at], most = bins->most[at], total = 0.0;
            for (int64_t cycle = begin; cycle < end; cycle++) {
                if (isfinite(mine[cycle])) {
                    least = mine[cycle] < least ? mine[cycle] : least;
                    most = mine[cycle] > most ? mine[cycle] : most;
                    total += mine[cycle], known++;
                }
            }
            bins->least[at] = least, bins->most[at] = most;
            bins->total[at] += total, bins->count[at] += (double)known;
        }
    }
}

/* Add the cycles of all joints. */
void movement_add(
    const Cycles *cycles, const Joints *joints, const Jumps *jumps, const Bins *bins, const Scratch *scratch)
{
    int64_t count = cycles->count - cycles->known;
    double *values[QUANTITIES];
    for (int quantity = 0; quantity < QUANTITIES; quantity++) {
        values[quantity] = scratch->values + quantity * count;
    }
    for (int64_t joint = 0; joint < joints->count; joint++) {
        int64_t row = joint * cycles->count + cycles->known;
        const double *way = cycles->way + row, *position = cycles->position + row;
        const double *goal = cycles->goal_position + row;
        double least = SWING_RAD * joints->share[joint], top = SLOWEST_TOP * joints->top_speed[joint];
        double fastest = joints->fastest[joint];
        for (int64_t at = 0; at < count; at++) {
            int on = cycles->torque[row + at] == cycles->torque_on, moves = on && cycles->valid[row + at];
            int by_effort = isfinite(cycles->goal_effort[row + at]), driven = moves && !by_effort;
            double free = driven ? position[at] : NAN, error = (isfinite(way[at]) ? free : NAN) - way[at];
            double speed = NAN, moved = 0.0, velocity = cycles->velocity[row + at];
            if (cycles->known + at > 0) {
                double step = cycles->steps[cycles->known + at - 1];
                speed = fabs(way[at] - way[at - 1]) / step, moved = fabs(position[at] - position[at - 1]) / step;
            }
            if (driven || !on) {
                int64_t at_ns = minus(cycles->read_ns[cycles->known + at], cycles->age_ns[row + at]);
                add_position(joints, jumps, joint, at_ns, free);
            }
            velocity = isnan(velocity) ? 0.0 : isinf(velocity) ? copysign(DBL_MAX, velocity) : velocity;
            double quick = fabs(velocity);
            fastest = larger(fastest, quick);
            /* A joint that approaches its goal at full speed is not at fault for its error. */
            int hurries = velocity * error < 0.0 && quick >= FULL_SPEED * larger(fastest, top) &&
                          moved >= FULL_SPEED / 2 * quick;
            int unknown = isnan(error);
            values[ERROR][at] = error, values[WAY][at] = unknown ? NAN : way[at];
            values[POSITION][at] = unknown ? NAN : free, values[SPEED][at] = unknown ? NAN : speed;
            values[LOAD][at] = unknown ? NAN : fabs(cycles->effort[row + at]);
            values[AWAY][at] = hurries ? 0.0 : fabs(error);
            scratch->free[joint * count + at] = free, scratch->off[at] = error, scratch->led[at] = way[at];
            if (unknown) {
                /* A joint that a controller moves with an effort has no reachable trajectory. */
                int64_t column = moves && by_effort ? joints->reference[joint] : -1;
                scratch->led[at] = column < 0 ? NAN : cycles->reference[column * cycles->count + cycles->known + at];
                scratch->off[at] = position[at] - scratch->led[at];
            }
            values[SWINGS][at] = values[GOALS][at] = scratch->marks[at] = 0.0;
        }
        joints->fastest[joint] = fastest;
        mark_swings(scratch->off, count, least, cycles->rate, values[SWINGS]);
        mark_swings(scratch->led, count, least, cycles->rate, scratch->marks);
        mark_swings(goal, count, least, cycles->rate, values[GOALS]);
        for (int64_t at = 0; at < count; at++) {
            /* A step of a goal that was constant before counts as two swings. */
            int steps = at > 1 && goal[at - 1] - goal[at - 2] == 0.0 && fabs(goal[at] - goal[at - 1]) >= least;
            double told = steps ? larger(scratch->marks[at], 2.0 * cycles->rate) : scratch->marks[at];
            values[SWINGS][at] = isnan(scratch->off[at]) ? NAN : values[SWINGS][at] - told;
            values[GOALS][at] = isnan(values[ERROR][at]) ? NAN : values[GOALS][at];
        }
        add_to_bins(bins, joints->count, joint, cycles->bin, scratch->values, count);
    }
}
