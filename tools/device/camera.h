/* The camera: stopped, or exposing from the fast step that CameraControl named. */
#ifndef CAMERA_H
#define CAMERA_H

#include "line.h"
#include "rig.h"

struct camera {
    struct line line;
    struct rig *rig;
    int64_t step_zero_ns;
    uint64_t step; /* the fast step that is going on */
    struct camera_control control; /* the newest start; run is false when its exposures are over */
    bool started;                  /* no stop has come since */
    uint64_t frame_step;           /* the first step of the exposure that is next to end */
    uint64_t frame_id;             /* of that exposure; it grows for as long as the device runs, through all sessions */
};

/* The device time at which fast step 0 begins, and now is in it. */
void camera_begin(struct camera *camera, struct rig *rig, int64_t step_zero_ns);

/* The next fast step begins; the rig has made the one before. */
void camera_tick(struct camera *camera);

/* A byte has come on the camera's line, at this device time. */
void camera_take(struct camera *camera, uint8_t byte, int64_t now_ns);

#endif
