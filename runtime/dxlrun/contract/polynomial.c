/* Polynomial pieces: evaluate those of some joints. `polynomial.py` fills the struct.
 *
 * A replay must give the same bits on every machine. So arithmetic is IEEE double in source order, built with
 * -ffp-contract=off.
 */

#include <stdint.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file. polynomial.py parses the struct here, and refuses an outdated object. */
#endif

typedef struct {
    const double *coefficients; /* (order, joints), of ascending powers */
    double *values;             /* (3, joints): position, velocity, acceleration */
    int32_t order, joints;
} Pieces;

uint32_t dxl_source(void)
{
    return SOURCE_CRC;
}

/* Horner's scheme for a polynomial and its first two derivatives. */
void evaluate_pieces(const Pieces *pieces, double t)
{
    int32_t joints = pieces->joints;
    for (int32_t joint = 0; joint < joints; joint++) {
        double position = 0.0, velocity = 0.0, half = 0.0; /* half of the acceleration */
        for (int32_t k = pieces->order - 1; k >= 0; k--) {
            half = half * t + velocity;
            velocity = velocity * t + position;
            position = position * t + pieces->coefficients[k * joints + joint];
        }
        pieces->values[joint] = position;
        pieces->values[joints + joint] = velocity;
        pieces->values[2 * joints + joint] = half * 2.0;
    }
}
