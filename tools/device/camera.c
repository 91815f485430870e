#include "camera.h"

#include <string.h>

/* Truth is written whole and sent in pieces: three lists of doubles, some small numbers, a few bytes for each key. */
enum { TRUTH_BYTES = 8 * (2 * N_STATES + EXPOSURE_STEPS) + 64 };

void camera_begin(struct camera *camera, struct rig *rig, int64_t step_zero_ns)
{
    memset(camera, 0, sizeof *camera);
    camera->rig = rig;
    camera->step_zero_ns = step_zero_ns;
    camera->frame_id = 1;
}

static int64_t begins_ns(const struct camera *camera, uint64_t step)
{
    return camera->step_zero_ns + (int64_t)step * FAST_STEP_NS + EXPOSURE_OFFSET_NS;
}

static void send_frame(struct camera *camera)
{
    uint8_t counts[2 * WIDTH * HEIGHT];
    uint64_t first = camera->frame_step;
    struct frame_chunk chunk = {.frame_id = camera->frame_id,
                                .first_step = first,
                                .last_step = first + EXPOSURE_STEPS - 1,
                                .total = sizeof counts,
                                .width = WIDTH,
                                .height = HEIGHT,
                                .exposure_offset_ns = EXPOSURE_OFFSET_NS,
                                .exposure_start_ns = begins_ns(camera, first),
                                .exposure_end_ns = begins_ns(camera, first + EXPOSURE_STEPS)};
    rig_frame(camera->rig, first, counts);
    for (; chunk.offset < chunk.total; chunk.offset += MAX_CHUNK) {
        struct writer writer = line_write(&camera->line);
        chunk.data = counts + chunk.offset;
        chunk.size = chunk.total - chunk.offset < MAX_CHUNK ? chunk.total - chunk.offset : MAX_CHUNK;
        frame_chunk_encode(&writer, &chunk);
        line_send(&camera->line, FRAME_CHUNK, &writer);
    }
}

static void send_truth(struct camera *camera)
{
    double start[N_STATES], end[N_STATES], path[EXPOSURE_STEPS];
    uint8_t bytes[TRUTH_BYTES];
    struct writer truth = {bytes, sizeof bytes, 0, false};
    rig_truth(camera->rig, camera->frame_step, start, end, path);
    put_uint(&truth, 1, camera->frame_id);
    put_uint(&truth, 2, 1); /* axes */
    put_uint(&truth, 3, 1); /* outputs */
    put_doubles(&truth, 4, start, N_STATES);
    put_doubles(&truth, 5, end, N_STATES);
    put_doubles(&truth, 6, path, EXPOSURE_STEPS);
    struct part piece = {.total = (uint32_t)truth.size};
    for (; piece.offset < piece.total; piece.offset += MAX_CHUNK) {
        struct writer writer = line_write(&camera->line);
        piece.data = bytes + piece.offset;
        piece.size = piece.total - piece.offset < MAX_CHUNK ? piece.total - piece.offset : MAX_CHUNK;
        truth_chunk_encode(&writer, camera->frame_id, &piece);
        line_send(&camera->line, TRUTH_CHUNK, &writer);
    }
}

void camera_tick(struct camera *camera)
{
    camera->step++;
    if (!camera->control.run || camera->step < camera->frame_step || camera->step - camera->frame_step < EXPOSURE_STEPS)
        return;
    send_frame(camera);
    send_truth(camera);
    camera->frame_id++;
    camera->frame_step += FRAME_PERIOD_STEPS;
    if (camera->control.exposures > 0 &&
        (camera->frame_step - camera->control.first_step) / FRAME_PERIOD_STEPS >= camera->control.exposures)
        camera->control.run = false;
}

static void identify(struct camera *camera, const struct packet *packet)
{
    uint8_t bytes[64]; /* five numbers of five bytes and a key at most */
    struct writer geometry = {bytes, sizeof bytes, 0, false}, writer = line_write(&camera->line);
    uint64_t nonce;
    if (!identify_decode(&nonce, packet->payload, packet->size))
        return;
    line_clear(&camera->line);
    camera->control.run = camera->started = false;
    put_uint(&geometry, 1, WIDTH);
    put_uint(&geometry, 2, HEIGHT);
    put_uint(&geometry, 3, BIT_DEPTH);
    put_uint(&geometry, 4, EXPOSURE_STEPS);
    put_uint(&geometry, 5, FRAME_PERIOD_STEPS);
    line_identity(&writer, nonce, KIND_CAMERA, MODEL_CAMERA, camera->step + 1, camera->step_zero_ns);
    put_bytes(&writer, 12, bytes, geometry.size);
    line_send(&camera->line, IDENTITY, &writer);
}

static void control(struct camera *camera, const struct packet *packet)
{
    struct camera_control asked, *now = &camera->control;
    if (!camera_control_decode(&asked, packet->payload, packet->size))
        return;
    /* The same again changes nothing, though its first step has gone by meanwhile, and though its exposures are over. */
    bool again = camera->started && asked.first_step == now->first_step && asked.exposures == now->exposures;
    if (asked.run && !again) {
        if (asked.first_step <= camera->step) {
            line_ack(&camera->line, packet, TOO_LATE, "the first step has gone by", 0);
            return;
        }
        *now = asked;
        camera->started = true;
        camera->frame_step = asked.first_step;
    } else if (!asked.run) {
        now->run = camera->started = false;
    }
    line_ack(&camera->line, packet, OK, "", 0);
}

void camera_take(struct camera *camera, uint8_t byte, int64_t now_ns)
{
    struct packet packet;
    if (!line_take(&camera->line, byte, &packet))
        return;
    switch (packet.type) {
    case IDENTIFY:
        identify(camera, &packet);
        break;
    case CAMERA_CONTROL:
        control(camera, &packet);
        break;
    case CLOCK_QUERY:
        line_clock_reply(&camera->line, &packet, now_ns);
        break;
    default:
        line_not_supported(&camera->line, &packet);
    }
}
