/* The simulated plant and optics. Firmware for a real camera or mirror replaces rig_step by the converter's output, and
 * rig_frame by the sensor's readout; it has no truth to tell. */
#ifndef RIG_H
#define RIG_H

#include <stdbool.h>
#include <stdint.h>

#include "section_vi.h"

/* Fast steps whose states are kept: an exposure, the state after it, and as much again for a late reader. */
enum { STATES_KEPT = 2 * (EXPOSURE_STEPS + 1) };

struct rig {
    uint64_t random[2];
    double spare; /* the second of a pair of normal numbers */
    bool has_spare;
    uint64_t step;                     /* the next: x(step) is known */
    double x[STATES_KEPT][N_STATES];
};

void rig_begin_at_rest(struct rig *rig, uint64_t seed);

/* The plant has moved for long: it is in its stationary state. */
void rig_begin(struct rig *rig, uint64_t seed);

/* From the beginning of the next fast step to its end, with this input. */
void rig_step(struct rig *rig, const double u[N_INPUTS]);

/* What the sensor counts from `first_step` on, little-endian words of 16 bits, and what really happened. The exposure
 * has ended and is among the steps that are kept. */
void rig_frame(struct rig *rig, uint64_t first_step, uint8_t counts[2 * WIDTH * HEIGHT]);
void rig_truth(const struct rig *rig, uint64_t first_step, double start[N_STATES], double end[N_STATES],
               double path[EXPOSURE_STEPS]);

#endif
