/* The rig "section-vi": every number here is lifted from aolink/rigs/section-vi.toml, whose key is beside it. A device
 * for another rig changes this file; rig.c knows plants of N_STATES states, and line sensors. */
#ifndef SECTION_VI_H
#define SECTION_VI_H

#define MODEL_CAMERA "aolink reference camera"
#define MODEL_MIRROR "aolink reference mirror"
#define FIRMWARE "1"
#define SERIAL_NUMBER "section-vi-reference" /* camera and mirror share it, because they share fast steps */
#define RIG_DIGEST "4b863693f191661182aad07c7853fa92a359c596053b512431cc9b738f1d65b8" /* sha256sum section-vi.toml */

enum { N_STATES = 2, N_INPUTS = 1 };
#define PLANT_A {{1.0000, 0.0010}, {-0.0197, 0.9704}} /* plant.A */
#define PLANT_B {{0.0}, {1.0}}                        /* plant.B */
#define PLANT_B_W {0.0, 0.05}                         /* plant.B_w */
#define PLANT_C {1.0, 0.0}                            /* plant.C */
#define PROCESS_NOISE 0.1                             /* plant.process_noise, a variance */

enum {
    FAST_STEP_NS = 1000000,   /* timing.fast_step_s */
    EXPOSURE_STEPS = 200,     /* timing.exposure_steps */
    FRAME_PERIOD_STEPS = 200, /* timing.frame_period_steps: as many */
    EXPOSURE_OFFSET_NS = 0,   /* timing.exposure_offset, times the fast step */
    WIDTH = 40,               /* sensor.pixels */
    HEIGHT = 1,
    BIT_DEPTH = 16 /* sensor.bit_depth */
};

#define FIELD_LOW (-1.0) /* sensor.field, slope units */
#define FIELD_HIGH 1.0
#define NOISE_DENSITY 0.1         /* sensor.noise_density */
#define BLACK_LEVEL 20000.0       /* sensor.black_level */
#define COUNTS_PER_DENSITY 2000.0 /* sensor.counts_per_density */
#define KERNEL_SIGMA 0.05         /* sensor.kernel.sigma */

#define INPUT_MIN (-0.05) /* mirror.input_min */
#define INPUT_MAX 0.05    /* mirror.input_max */
#define PARK_INPUTS {0.0} /* mirror.park, of each input */
enum {
    DAC_BITS = 16,     /* mirror.dac_bits */
    BLOCK_STEPS = 50,  /* mirror.block_steps: a report is as long as a block at most */
    QUEUE_STEPS = 400, /* mirror.queue_steps, its default: eight blocks */
    HISTORY_STEPS = 3695 /* three and a half times the watchdog: an outage of twice its time is survived, what was held then is asked for */
};
#define WATCHDOG_NS 1000000000 /* mirror.watchdog_s, its default */

#define SEED 1                    /* simulation.seed */
#define CLOCK_OFFSET_NS 250000000 /* simulation.clock_offset_s */
#define CLOCK_DRIFT 20e-6         /* simulation.clock_drift_ppm */

#endif
