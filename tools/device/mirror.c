#include "mirror.h"

#include <math.h>
#include <string.h>

/* A report is made from the ring: what has not been reported must still be there. */
typedef char history_holds_a_report[HISTORY_STEPS > BLOCK_STEPS ? 1 : -1];

static const struct held parked = {PARK_INPUTS, 0, SOURCE_PARKED};

static struct held *at(struct mirror *mirror, uint64_t step)
{
    return &mirror->ring[step % RING_STEPS];
}

/* The step that has begun can no longer be changed. */
static uint64_t next_step(const struct mirror *mirror)
{
    return mirror->step + 1;
}

static uint64_t oldest_step(const struct mirror *mirror)
{
    return mirror->step > HISTORY_STEPS ? mirror->step - HISTORY_STEPS : 0;
}

void mirror_begin(struct mirror *mirror, struct rig *rig, int64_t step_zero_ns)
{
    memset(mirror, 0, sizeof *mirror);
    mirror->rig = rig;
    mirror->step_zero_ns = step_zero_ns;
    mirror->ring[0] = parked;
    mirror->queue_end = 1;
    rig_step(rig, parked.u);
}

/* One report of steps that follow each other with one block and one source, from `first` on and before `end`. Returns
 * the step that it ends before. */
static uint64_t report(struct mirror *mirror, uint64_t first, uint64_t end)
{
    const struct held *like = at(mirror, first);
    struct applied applied = {.block_id = like->block_id, .first_step = first, .source = like->source};
    uint64_t step = first;
    for (; step < end && step - first < MAX_REPORT_STEPS; step++) {
        const struct held *held = at(mirror, step);
        if (held->block_id != like->block_id || held->source != like->source)
            break;
        memcpy(&mirror->u[(step - first) * N_INPUTS], held->u, sizeof held->u);
    }
    applied.n_steps = (uint32_t)(step - first);
    applied.device_ns = mirror->step_zero_ns + (int64_t)step * FAST_STEP_NS;
    struct writer writer = line_write(&mirror->line);
    applied_encode(&writer, &applied, mirror->u, (size_t)applied.n_steps * N_INPUTS);
    line_send(&mirror->line, APPLIED, &writer);
    return step;
}

static void report_until(struct mirror *mirror, uint64_t end)
{
    while (mirror->reporting && mirror->report_step < end)
        mirror->report_step = report(mirror, mirror->report_step, end);
}

void mirror_tick(struct mirror *mirror)
{
    uint64_t step = ++mirror->step;
    struct held *now = at(mirror, step), *before = at(mirror, step - 1);
    if (now->block_id == 0)
        *now = parked;
    if (mirror->latched)
        now->source = SOURCE_WATCHDOG;
    rig_step(mirror->rig, now->u);
    if (mirror->queue_end < next_step(mirror))
        mirror->queue_end = next_step(mirror);
    at(mirror, step + QUEUE_STEPS)->block_id = 0; /* the oldest step makes room for the end of the queue */
    /* A report goes out when its run ends, and when it is as long as a block. */
    if (mirror->report_step < step && (now->block_id != before->block_id || now->source != before->source ||
                                       step - mirror->report_step >= BLOCK_STEPS))
        report_until(mirror, step);
}

static void clear_queue(struct mirror *mirror)
{
    for (uint64_t step = next_step(mirror); step < mirror->queue_end; step++)
        at(mirror, step)->block_id = 0;
    mirror->queue_end = next_step(mirror);
    mirror->armed = false;
}

void mirror_watchdog(struct mirror *mirror, int64_t now_ns)
{
    if (mirror->armed && now_ns - mirror->last_valid_ns >= WATCHDOG_NS) {
        clear_queue(mirror);
        mirror->latched = true;
        line_event(&mirror->line, LEVEL_WARNING, now_ns, "parked by the watchdog: no valid packet has come for watchdog_s");
    }
}

static bool identify(struct mirror *mirror, const struct packet *packet)
{
    uint8_t bytes[3 * (8 * N_INPUTS + 4) + 40]; /* three lists, seven small numbers and a double, and their keys */
    struct writer limits = {bytes, sizeof bytes, 0, false}, writer = line_write(&mirror->line);
    double lowest[N_INPUTS], highest[N_INPUTS];
    double watchdog_s = WATCHDOG_NS * 1e-9;
    uint64_t nonce;
    if (!identify_decode(&nonce, packet->payload, packet->size))
        return false;
    for (int i = 0; i < N_INPUTS; i++) {
        lowest[i] = INPUT_MIN;
        highest[i] = INPUT_MAX;
    }
    put_uint(&limits, 1, N_INPUTS);
    put_doubles(&limits, 2, lowest, N_INPUTS);
    put_doubles(&limits, 3, highest, N_INPUTS);
    put_doubles(&limits, 4, parked.u, N_INPUTS);
    put_uint(&limits, 5, DAC_BITS);
    put_uint(&limits, 6, QUEUE_STEPS);
    put_double(&limits, 7, watchdog_s);
    put_uint(&limits, 8, at(mirror, mirror->step)->block_id == 0);
    put_uint(&limits, 9, mirror->latched);
    put_uint(&limits, 10, HISTORY_STEPS);
    line_clear(&mirror->line);
    clear_queue(mirror);
    mirror->reporting = false;
    mirror->n_answers = mirror->next_answer = 0; /* block_id starts at 1 again */
    line_identity(&writer, nonce, KIND_MIRROR, MODEL_MIRROR, next_step(mirror), mirror->step_zero_ns);
    put_bytes(&writer, 13, bytes, limits.size);
    line_send(&mirror->line, IDENTITY, &writer);
    return true;
}

/* Rounded to the converter's steps, which begin at the lowest input and end at the highest. */
static double converted(double u)
{
    const double step = (INPUT_MAX - INPUT_MIN) / ((1 << DAC_BITS) - 1);
    return INPUT_MIN + step * floor((u - INPUT_MIN) / step + 0.5);
}

static bool beyond_limits(const double *u, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (!(u[i] >= INPUT_MIN && u[i] <= INPUT_MAX)) /* so that NaN is beyond them */
            return true;
    return false;
}

/* Judges a block that has not been answered, and takes it where it can. */
static void judge(struct mirror *mirror, const struct command_block *block, struct command_ack *ack)
{
    uint64_t next = next_step(mirror), room_end = next + QUEUE_STEPS;
    uint64_t late = block->first_step < next ? next - block->first_step : 0;
    ack->text = "";
    if (block->block_id == 0 || block->n_steps == 0 || block->n_u > MAX_INPUTS ||
        block->n_u != (uint64_t)block->n_steps * N_INPUTS) {
        ack->code = WRONG_SHAPE;
        ack->text = "a block has an id, a step at least, and n_steps x n_inputs inputs";
    } else if (beyond_limits(mirror->u, block->n_u)) {
        ack->code = OUT_OF_RANGE;
        ack->text = "an input is beyond the limits";
    } else if (mirror->latched) {
        ack->code = LATCHED;
        ack->text = "the watchdog has parked the mirror: send Rearm";
    } else if (late >= block->n_steps) {
        ack->code = TOO_LATE;
        ack->late_steps = block->n_steps;
        ack->text = "every step has gone by";
    } else if (block->first_step > room_end || block->n_steps > room_end - block->first_step) {
        ack->code = QUEUE_FULL;
        ack->text = "the queue does not reach so far: send it again later";
    } else {
        ack->late_steps = (uint32_t)late;
        for (uint32_t i = (uint32_t)late; i < block->n_steps; i++) {
            struct held *held = at(mirror, block->first_step + i);
            ack->superseded_steps += held->block_id != 0;
            held->block_id = block->block_id;
            held->source = SOURCE_COMMAND;
            for (int j = 0; j < N_INPUTS; j++)
                held->u[j] = converted(mirror->u[i * N_INPUTS + (uint32_t)j]);
        }
        if (mirror->queue_end < block->first_step + block->n_steps)
            mirror->queue_end = block->first_step + block->n_steps;
        if (!mirror->reporting)
            mirror->report_step = next;
        mirror->reporting = mirror->armed = true;
    }
    ack->queue_end_step = mirror->queue_end;
}

static bool command(struct mirror *mirror, const struct packet *packet)
{
    struct command_block block;
    struct command_ack ack = {.sequence = packet->sequence};
    struct writer writer = line_write(&mirror->line);
    if (!command_block_decode(&block, mirror->u, MAX_INPUTS, packet->payload, packet->size))
        return false;
    ack.block_id = block.block_id;
    unsigned i = 0;
    while (i < mirror->n_answers && mirror->answers[i].block_id != block.block_id)
        i++;
    if (i < mirror->n_answers) {
        ack = mirror->answers[i];
        ack.sequence = packet->sequence; /* the rest is the same as before */
    } else {
        judge(mirror, &block, &ack);
        if (ack.code != QUEUE_FULL) {
            mirror->answers[mirror->next_answer] = ack;
            mirror->next_answer = (mirror->next_answer + 1) % ANSWERS;
            if (mirror->n_answers < ANSWERS)
                mirror->n_answers++;
        }
    }
    command_ack_encode(&writer, &ack);
    line_send(&mirror->line, COMMAND_ACK, &writer);
    return true;
}

static void park(struct mirror *mirror, const struct packet *packet)
{
    /* The step that is going on keeps its input and is reported: the safe one begins with the next step. */
    report_until(mirror, next_step(mirror));
    mirror->reporting = false;
    clear_queue(mirror);
    line_ack(&mirror->line, packet, OK, "", next_step(mirror));
}

static bool query(struct mirror *mirror, const struct packet *packet)
{
    struct applied_query query;
    if (!applied_query_decode(&query, packet->payload, packet->size))
        return false;
    /* Only the steps before the one that is going on have gone by. */
    uint64_t first = query.first_step, left = first < mirror->step ? mirror->step - first : 0;
    uint64_t end = first + (query.n_steps < left ? query.n_steps : left), oldest = oldest_step(mirror);
    if (first < end && first < oldest) {
        uint64_t known = end < oldest ? end : oldest;
        struct applied applied = {.first_step = first, .source = SOURCE_NOT_REPORTED};
        struct writer writer = line_write(&mirror->line);
        applied.n_steps = (uint32_t)(known - first);
        applied_encode(&writer, &applied, NULL, 0);
        line_send(&mirror->line, APPLIED, &writer);
        first = known;
    }
    if (first < end)
        report(mirror, first, end);
    return true;
}

/* False where the payload is no message. */
static bool deal_with(struct mirror *mirror, const struct packet *packet, int64_t now_ns)
{
    switch (packet->type) {
    case IDENTIFY:
        return identify(mirror, packet);
    case COMMAND_BLOCK:
        return command(mirror, packet);
    case PARK:
        park(mirror, packet);
        return true;
    case CLOCK_QUERY:
        return line_clock_reply(&mirror->line, packet, now_ns);
    case APPLIED_QUERY:
        return query(mirror, packet);
    case REARM:
        mirror->latched = false;
        line_ack(&mirror->line, packet, OK, "", next_step(mirror));
        return true;
    default:
        return line_not_supported(&mirror->line, packet);
    }
}

void mirror_take(struct mirror *mirror, uint8_t byte, int64_t now_ns)
{
    struct packet packet;
    /* The watchdog wants packets that mean something: noise with the right checksum is no host. */
    if (line_take(&mirror->line, byte, &packet) && deal_with(mirror, &packet, now_ns))
        mirror->last_valid_ns = now_ns;
}
