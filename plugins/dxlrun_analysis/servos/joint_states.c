/* Joint states: angle, speed and temperature of joints as bins, and the time in each bin. `joint_states.py` fills the
 * structs. A log can contain any times, so sums of times wrap.
 */

#include <math.h>
#include <stdint.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: joint_states.py rejects an object of another version */
#endif

#define NS 1e-9

typedef struct {
    const int64_t *cycle, *period_ns;
    double *angle;      /* rad, NaN if unknown; this and the next columns have shape (joints, cycles) */
    const double *heat; /* deg C */
    const uint8_t *usable;
    int64_t count, joints;
} States;

typedef struct {
    const double *step, *first; /* width of a bin, and lower edge of the first one in widths; shape (quantities,) */
    int16_t *at;                /* bin of each value, -1 if unknown or not usable; shape (quantities, joints, until) */
    int64_t *time_ns;           /* time in each bin; shape (joints, quantities, bins) */
    int64_t until, quantities, bins;
} Bins;

uint32_t dxl_source(void)
{
    return SOURCE_CRC;
}

/* Replace unknown values by a line between their neighbours, or by the first or last known value. */
static void interpolate(const int64_t *cycle, double *values, int64_t count)
{
    for (int64_t at = 0, before = -1, after = 0; at < count; at++) {
        if (isfinite(values[at])) {
            before = at;
            continue;
        }
        for (after = after > at ? after : at; after < count && !isfinite(values[after]); after++) {
        }
        if (before < 0 && after == count) {
            return;
        }
        if (before < 0 || after == count) {
            values[at] = values[before < 0 ? after : before];
        } else {
            double slope = (values[after] - values[before]) / ((double)cycle[after] - (double)cycle[before]);
            values[at] = slope * ((double)cycle[at] - (double)cycle[before]) + values[before];
        }
    }
}

/* Interpolate the angles; put the first `until` cycles into bins, and add their periods. */
void joint_states_bin(const States *states, const Bins *bins)
{
    for (int64_t joint = 0; joint < states->joints; joint++) {
        int64_t row = joint * states->count;
        double *angle = states->angle + row;
        interpolate(states->cycle, angle, states->count);
        for (int64_t at = 0; at < bins->until; at++) {
            double values[] = {angle[at], NAN, states->heat[row + at]};
            if (at > 0 && at < states->count - 1) {
                uint64_t cycles = (uint64_t)states->cycle[at + 1] - (uint64_t)states->cycle[at - 1];
                double took_s = (double)(int64_t)(cycles * (uint64_t)states->period_ns[at]) * NS;
                values[1] = fabs(angle[at + 1] - angle[at - 1]) / (took_s > NS ? took_s : NS);
            }
            for (int64_t quantity = 0; quantity < bins->quantities; quantity++) {
                int16_t *bin = bins->at + (quantity * states->joints + joint) * bins->until + at;
                if (!isfinite(values[quantity]) || !states->usable[row + at]) {
                    *bin = -1;
                    continue;
                }
                double step = floor(values[quantity] / bins->step[quantity]) - bins->first[quantity];
                double most = (double)(bins->bins - 1);
                *bin = (int16_t)(step < 0 ? 0 : step > most ? most : step);
                int64_t *sum = bins->time_ns + (joint * bins->quantities + quantity) * bins->bins + *bin;
                *sum = (int64_t)((uint64_t)*sum + (uint64_t)states->period_ns[at]);
            }
        }
    }
}
