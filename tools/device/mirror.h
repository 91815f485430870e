/* The mirror: parked, armed or latched; its queue, its memory of what it held, its answers. */
#ifndef MIRROR_H
#define MIRROR_H

#include "line.h"
#include "rig.h"

enum {
    /* One ring of fast steps: those that have gone by, the one that is going on, those that are queued. */
    RING_STEPS = HISTORY_STEPS + 1 + QUEUE_STEPS,
    ANSWERS = 64, /* to the newest blocks, which may come again */
    /* The inputs that fit into a payload, which bounds a block and a report. */
    MAX_INPUTS = MAX_PAYLOAD / 8,
    /* A report's other fields: three keys and numbers of 11 bytes at most, two of 6, a length of 3. */
    MAX_REPORT_STEPS = (MAX_PAYLOAD - 64) / (8 * N_INPUTS)
};

struct held {
    double u[N_INPUTS]; /* as converted */
    uint64_t block_id;  /* 0 for a queued step: nothing is queued for it */
    enum source source;
};

struct mirror {
    struct line line;
    struct rig *rig;
    int64_t step_zero_ns;
    uint64_t step; /* the fast step that is going on */
    uint64_t queue_end; /* the step after the last queued one */
    struct held ring[RING_STEPS];
    bool armed;     /* the watchdog runs */
    bool latched;   /* the watchdog has parked the mirror */
    bool reporting; /* from the first block of a session, or after Park */
    uint64_t report_step;  /* the first step that has not been reported */
    int64_t last_valid_ns; /* when the newest packet came */
    struct command_ack answers[ANSWERS];
    unsigned n_answers, next_answer;
    double u[MAX_INPUTS]; /* of the block or the report that is being dealt with */
};

/* The device time at which fast step 0 begins, and now is in it. */
void mirror_begin(struct mirror *mirror, struct rig *rig, int64_t step_zero_ns);

/* The next fast step begins. */
void mirror_tick(struct mirror *mirror);

/* A byte has come on the mirror's line, at this device time. */
void mirror_take(struct mirror *mirror, uint8_t byte, int64_t now_ns);

/* To be called often, after the bytes that have come by `now_ns`. */
void mirror_watchdog(struct mirror *mirror, int64_t now_ns);

#endif
