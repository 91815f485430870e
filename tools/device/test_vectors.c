/* The decoder, the parts and the codec against aolink/wire/vectors.json; then the devices' states, step by step. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "camera.h"
#include "mirror.h"

struct bytes {
    const uint8_t *bytes;
    size_t size;
};
struct good {
    const char *what;
    uint8_t version, type;
    uint16_t sequence;
    struct bytes payload, wire;
};
struct broken {
    const char *what;
    struct bytes wire;
    uint32_t bad_crc, bad_framing;
};
struct in_parts {
    const char *what;
    struct bytes wire;
    uint8_t type; /* 0: no message comes of it */
    struct bytes payload;
    uint32_t refused;
};

#include "vectors.h"

#define N(array) (sizeof(array) / sizeof(array)[0])
#define CHECK(what, condition) check(what, condition, #condition, __LINE__)

static int checks;

static void check(const char *what, bool holds, const char *condition, int line)
{
    checks++;
    if (!holds) {
        fprintf(stderr, "test_vectors.c:%d: %s: %s does not hold\n", line, what, condition);
        exit(1);
    }
}

static bool same(struct bytes a, const uint8_t *bytes, size_t size)
{
    return a.size == size && (size == 0 || memcmp(a.bytes, bytes, size) == 0);
}

static void test_good(void)
{
    static struct decoder decoder; /* one for all: each vector ends with a delimiter */
    for (size_t i = 0; i < N(good); i++) {
        const struct good *vector = &good[i];
        struct packet packet;
        uint8_t wire[MAX_WIRE];
        size_t found = 0;
        for (size_t j = 0; j < vector->wire.size; j++)
            found += decoder_take(&decoder, vector->wire.bytes[j], &packet);
        CHECK(vector->what, found == 1);
        CHECK(vector->what, packet.version == vector->version && packet.type == vector->type);
        CHECK(vector->what, packet.sequence == vector->sequence);
        CHECK(vector->what, same(vector->payload, packet.payload, packet.size));
        if (vector->version == PROTOCOL_VERSION) {
            size_t size = packet_encode(wire, packet.type, packet.sequence, packet.payload, packet.size);
            CHECK(vector->what, same(vector->wire, wire, size));
        }
    }
    CHECK("good", decoder.bad_crc == 0 && decoder.bad_framing == 0);
}

/* The vector of another version is an Identify: its sender is told why it is not taken. */
static void test_another_version(void)
{
    static struct line line;
    struct packet packet;
    for (size_t i = 0; i < N(good); i++) {
        if (good[i].version == PROTOCOL_VERSION)
            continue;
        for (size_t j = 0; j < good[i].wire.size; j++)
            CHECK(good[i].what, !line_take(&line, good[i].wire.bytes[j], &packet));
        CHECK(good[i].what, good[i].type == IDENTIFY && line.out_size > 0);
    }
}

static void test_broken(void)
{
    static struct decoder decoder;
    for (size_t i = 0; i < N(broken); i++) {
        const struct broken *vector = &broken[i];
        struct packet packet;
        decoder.bad_crc = decoder.bad_framing = 0;
        for (size_t j = 0; j < vector->wire.size; j++)
            CHECK(vector->what, !decoder_take(&decoder, vector->wire.bytes[j], &packet));
        CHECK(vector->what, decoder.bad_crc == vector->bad_crc && decoder.bad_framing == vector->bad_framing);
    }
}

static void test_parts(void)
{
    static uint8_t buffer[MAX_MESSAGE];
    for (size_t i = 0; i < N(in_parts); i++) {
        const struct in_parts *vector = &in_parts[i];
        static struct decoder decoder;
        struct parts parts = {.bytes = buffer, .room = sizeof buffer};
        struct packet packet;
        size_t found = 0;
        for (size_t j = 0; j < vector->wire.size; j++) {
            if (!decoder_take(&decoder, vector->wire.bytes[j], &packet) || !parts_take(&parts, &packet))
                continue;
            found++;
            CHECK(vector->what, packet.type == vector->type && same(vector->payload, packet.payload, packet.size));
        }
        CHECK(vector->what, found == (vector->type != 0) && parts.refused == vector->refused);
    }
}

static const struct good *vector_of(const char *what)
{
    for (size_t i = 0; i < N(good); i++)
        if (strncmp(good[i].what, what, strlen(what)) == 0)
            return &good[i];
    CHECK(what, false);
    return NULL;
}

/* vectors.json has no fields but in words: these are read off its payloads. */
static void test_codec(void)
{
    uint8_t bytes[MAX_PAYLOAD];
    const struct good *vector = vector_of("CommandBlock of two steps");
    struct command_block block;
    double u[4], zeros[2] = {0.0, 0.0};
    CHECK(vector->what, command_block_decode(&block, u, N(u), vector->payload.bytes, vector->payload.size));
    CHECK(vector->what, block.block_id == 1 && block.first_step == 100 && block.n_steps == 2);
    CHECK(vector->what, block.cause_frame_id == 3 && block.n_u == 2 && u[0] == 0.25 && u[1] == -0.5);

    vector = vector_of("AppliedQuery");
    struct applied_query query;
    CHECK(vector->what, applied_query_decode(&query, vector->payload.bytes, vector->payload.size));
    CHECK(vector->what, query.first_step == 100 && query.n_steps == 50);

    vector = vector_of("Identify with nonce");
    uint64_t nonce;
    CHECK(vector->what, identify_decode(&nonce, vector->payload.bytes, vector->payload.size) && nonce == 305419896);

    struct writer w = {bytes, sizeof bytes, 0, false};
    vector = vector_of("CommandAck that refuses while");
    command_ack_encode(&w, &(struct command_ack){.block_id = 4, .code = LATCHED, .text = "", .queue_end_step = 102,
                                                 .sequence = 120});
    CHECK(vector->what, same(vector->payload, bytes, w.size));

    w.size = 0;
    vector = vector_of("CommandAck that refuses");
    command_ack_encode(&w, &(struct command_ack){.block_id = 1, .code = OUT_OF_RANGE,
                                                 .text = "an input is beyond the limits"});
    CHECK(vector->what, same(vector->payload, bytes, w.size));

    w.size = 0;
    vector = vector_of("FrameChunk");
    frame_chunk_encode(&w, &(struct frame_chunk){.frame_id = 7, .total = 8, .width = 4, .height = 1, .first_step = 200,
                                                 .last_step = 399, .exposure_start_ns = 1000250000,
                                                 .exposure_end_ns = 1200250000, .exposure_offset_ns = 250000,
                                                 .data = (const uint8_t *)"\0\0\1\0\0\1\377\377", .size = 8});
    CHECK(vector->what, same(vector->payload, bytes, w.size));

    w.size = 0;
    vector = vector_of("ClockReply");
    clock_reply_encode(&w, &(struct clock_query){9, 1000000000000000000}, 500000000, 500000800);
    CHECK(vector->what, same(vector->payload, bytes, w.size));

    w.size = 0;
    vector = vector_of("Applied, the answer: parked");
    applied_encode(&w, &(struct applied){.first_step = 100, .n_steps = 2, .source = SOURCE_WATCHDOG,
                                         .device_ns = 102000000}, zeros, 2);
    CHECK(vector->what, same(vector->payload, bytes, w.size));

    w.size = 0;
    vector = vector_of("Applied, the answer where");
    applied_encode(&w, &(struct applied){.first_step = 100, .n_steps = 50, .source = SOURCE_NOT_REPORTED}, NULL, 0);
    CHECK(vector->what, same(vector->payload, bytes, w.size));

    w.size = 0;
    vector = vector_of("Ack of a Rearm");
    ack_encode(&w, 160, OK, "", 103);
    CHECK(vector->what, same(vector->payload, bytes, w.size));
}

/* A host before the mirror's line: it sends one message, and keeps what came back. */
static struct rig rig;
static struct mirror mirror;
static struct camera camera;
static uint16_t host_sequence;
static struct answer {
    uint8_t type;
    uint8_t payload[MAX_PAYLOAD];
    size_t size;
} answers[8];
static size_t n_answers;

static int64_t now_ns(void)
{
    return mirror.step_zero_ns + (int64_t)mirror.step * FAST_STEP_NS;
}

static void collect(struct line *line)
{
    static struct decoder decoder;
    struct packet packet;
    n_answers = 0;
    for (size_t i = 0; i < line->out_size; i++) {
        if (!decoder_take(&decoder, line->out[i], &packet))
            continue;
        CHECK("answers", n_answers < N(answers));
        answers[n_answers].type = packet.type;
        answers[n_answers].size = packet.size;
        memcpy(answers[n_answers++].payload, packet.payload, packet.size);
    }
    line->out_size = 0;
}

static void send(struct line *line, uint8_t type, const struct writer *w, uint16_t sequence)
{
    uint8_t wire[MAX_WIRE];
    size_t size = packet_encode(wire, type, sequence, w->bytes, w->size);
    for (size_t i = 0; i < size; i++) {
        if (line == &mirror.line)
            mirror_take(&mirror, wire[i], now_ns());
        else
            camera_take(&camera, wire[i], now_ns());
    }
}

static void ask(struct line *line, uint8_t type, const struct writer *w)
{
    line->out_size = 0;
    send(line, type, w, host_sequence++);
    collect(line);
}

static void ask_numbers(struct line *line, uint8_t type, uint64_t first, uint64_t second)
{
    uint8_t bytes[32];
    struct writer w = {bytes, sizeof bytes, 0, false};
    put_uint(&w, 1, first);
    put_uint(&w, 2, second);
    ask(line, type, &w);
}

static void ask_block(uint64_t id, uint64_t first_step, uint32_t n_steps, double input)
{
    static uint8_t bytes[MAX_PAYLOAD];
    static double u[MAX_INPUTS];
    struct writer w = {bytes, sizeof bytes, 0, false};
    for (uint32_t i = 0; i < n_steps; i++)
        u[i] = input;
    put_uint(&w, 1, id);
    put_uint(&w, 2, first_step);
    put_uint(&w, 3, n_steps);
    put_doubles(&w, 4, u, n_steps);
    ask(&mirror.line, COMMAND_BLOCK, &w);
}

static uint64_t number(size_t answer, uint32_t field)
{
    struct reader reader = reader_of(answers[answer].payload, answers[answer].size);
    uint64_t value = 0;
    while (next_field(&reader))
        if (reader.field == field)
            value = reader.wire == 2 ? reader.size : reader.value;
    return value;
}

static void tick(int steps)
{
    for (int i = 0; i < steps; i++) {
        mirror_tick(&mirror);
        camera_tick(&camera);
        mirror_watchdog(&mirror, now_ns());
    }
}

static void begin(void)
{
    rig_begin(&rig, 1);
    mirror_begin(&mirror, &rig, 0);
    camera_begin(&camera, &rig, 0);
    host_sequence = 0;
    tick(9);
    ask_numbers(&mirror.line, IDENTIFY, 77, 0);
    CHECK("Identify", n_answers == 1 && answers[0].type == IDENTITY && number(0, 1) == 77 && number(0, 9) == 10);
}

static void test_blocks(void)
{
    const char *what = "blocks";
    begin();
    ask_block(1, 20, 5, 0.01);
    CHECK(what, n_answers == 1 && answers[0].type == COMMAND_ACK && number(0, 2) == OK && number(0, 6) == 25);
    ask_block(1, 30, 5, 9.0); /* the same id: the same answer, whatever is in it */
    CHECK(what, number(0, 2) == OK && number(0, 6) == 25 && number(0, 7) == 2);
    ask_block(2, 22, 4, 0.02);
    CHECK(what, number(0, 5) == 3 && number(0, 6) == 26);
    ask_block(3, 1, 9, 0.0);
    CHECK(what, number(0, 2) == TOO_LATE && number(0, 4) == 9);
    ask_block(4, 8, 4, 0.0);
    CHECK(what, number(0, 2) == OK && number(0, 4) == 2);
    ask_block(5, 30, 2, 0.0501);
    CHECK(what, number(0, 2) == OUT_OF_RANGE);
    ask_block(6, 30, 2, (double)NAN);
    CHECK(what, number(0, 2) == OUT_OF_RANGE);
    ask_block(7, 30, 0, 0.0);
    CHECK(what, number(0, 2) == WRONG_SHAPE);
    ask_block(8, 400, 30, 0.0);
    CHECK(what, number(0, 2) == QUEUE_FULL);
    ask_block(9, UINT64_MAX, 2, 0.0);
    CHECK(what, number(0, 2) == QUEUE_FULL);
    mirror.line.out_size = 0;
    tick(20); /* now in step 29: up to 28 have been held; the last source but one ended with step 25 */
    collect(&mirror.line);
    static const uint64_t expected[][4] = {/* block, first step, steps, source */
        {4, 10, 2, SOURCE_COMMAND}, {0, 12, 8, SOURCE_PARKED}, {1, 20, 2, SOURCE_COMMAND}, {2, 22, 4, SOURCE_COMMAND}};
    CHECK(what, n_answers == N(expected));
    for (size_t i = 0; i < n_answers; i++) {
        CHECK(what, answers[i].type == APPLIED && number(i, 1) == expected[i][0] && number(i, 2) == expected[i][1]);
        CHECK(what, number(i, 3) == expected[i][2] && number(i, 5) == expected[i][3]);
        CHECK(what, number(i, 4) == 8 * expected[i][2]);
        CHECK(what, number(i, 6) == (expected[i][1] + expected[i][2]) * FAST_STEP_NS);
    }
    ask_block(8, 400, 30, 0.0); /* QUEUE_FULL is judged anew */
    CHECK(what, number(0, 2) == OK);
    ask_numbers(&mirror.line, PARK, 0, 0);
    CHECK(what, n_answers == 2 && answers[0].type == APPLIED && number(0, 2) == 26 && number(0, 3) == 4);
    CHECK(what, answers[1].type == ACK && number(1, 2) == OK && number(1, 4) == 30);
}

static void test_watchdog(void)
{
    const char *what = "watchdog";
    begin();
    tick(3000); /* not armed */
    CHECK(what, !mirror.latched);
    ask_block(1, mirror.step + 1, 10, 0.01);
    CHECK(what, number(0, 2) == OK);
    tick(999);
    CHECK(what, !mirror.latched);
    mirror.line.out_size = 0;
    tick(1);
    CHECK(what, mirror.latched);
    collect(&mirror.line);
    CHECK(what, n_answers >= 1 && answers[n_answers - 1].type == EVENT);
    ask_block(2, mirror.step + 1, 10, 0.01);
    CHECK(what, number(0, 2) == LATCHED);
    ask_numbers(&mirror.line, PARK, 0, 0);
    ask_numbers(&mirror.line, IDENTIFY, 78, 0);
    CHECK(what, mirror.latched);
    ask_block(1, mirror.step + 1, 10, 0.01);
    CHECK(what, number(0, 2) == LATCHED);
    tick(3);
    ask_numbers(&mirror.line, APPLIED_QUERY, mirror.step - 2, 2);
    CHECK(what, n_answers == 1 && number(0, 3) == 2 && number(0, 5) == SOURCE_WATCHDOG);
    ask_numbers(&mirror.line, REARM, 0, 0);
    CHECK(what, answers[0].type == ACK && number(0, 2) == OK);
    ask_block(2, mirror.step + 1, 10, 0.01);
    CHECK(what, number(0, 2) == OK);
}

static void test_history(void)
{
    const char *what = "history";
    begin();
    ask_block(1, 10, 10, 0.01);
    tick(50);
    ask_numbers(&mirror.line, APPLIED_QUERY, 5, 100); /* parked, and then a block: the answer ends where it begins */
    CHECK(what, n_answers == 1 && number(0, 2) == 5 && number(0, 3) == 5 && number(0, 5) == SOURCE_PARKED);
    ask_numbers(&mirror.line, APPLIED_QUERY, 15, 100);
    CHECK(what, n_answers == 1 && number(0, 1) == 1 && number(0, 2) == 15 && number(0, 3) == 5);
    ask_numbers(&mirror.line, APPLIED_QUERY, mirror.step, 10); /* it has not gone by */
    CHECK(what, n_answers == 0);
    for (int i = 0; i < HISTORY_STEPS / 50 + 8; i++) {
        tick(50);
        ask_numbers(&mirror.line, CLOCK_QUERY, 1, 2);
    }
    uint64_t oldest = mirror.step - HISTORY_STEPS;
    ask_numbers(&mirror.line, APPLIED_QUERY, 15, 2000000);
    CHECK(what, n_answers == 2 && number(0, 5) == SOURCE_NOT_REPORTED && number(0, 2) == 15 && number(0, 4) == 0);
    CHECK(what, number(0, 3) == oldest - 15 && number(1, 2) == oldest && number(1, 3) == MAX_REPORT_STEPS);
    ask_numbers(&mirror.line, APPLIED_QUERY, 15, 20);
    CHECK(what, n_answers == 1 && number(0, 3) == 20 && number(0, 5) == SOURCE_NOT_REPORTED);
}

static void test_duplicates(void)
{
    const char *what = "duplicates";
    struct writer empty = {NULL, 0, 0, false};
    begin();
    ask(&mirror.line, 99, &empty); /* no message has this number */
    CHECK(what, n_answers == 0);
    ask(&mirror.line, REARM, &empty);
    CHECK(what, n_answers == 1);
    send(&mirror.line, REARM, &empty, (uint16_t)(host_sequence - 1));
    CHECK(what, mirror.line.out_size == 0 && mirror.line.window.duplicates == 1);
    host_sequence += 3;
    ask(&mirror.line, REARM, &empty);
    CHECK(what, n_answers == 1 && mirror.line.window.lost == 3);
    host_sequence = 0; /* a new host */
    ask_numbers(&mirror.line, IDENTIFY, 79, 0);
    CHECK(what, n_answers == 1 && answers[0].type == IDENTITY);
    ask(&mirror.line, REARM, &empty);
    CHECK(what, n_answers == 1);
}

static void test_block_in_parts(void)
{
    const struct in_parts *vector = &in_parts[2]; /* one step of three inputs, which this mirror has not */
    begin();
    for (size_t i = 0; i < vector->wire.size; i++)
        mirror_take(&mirror, vector->wire.bytes[i], now_ns());
    collect(&mirror.line);
    CHECK(vector->what, n_answers == 1 && answers[0].type == COMMAND_ACK && number(0, 1) == 2 && number(0, 2) == WRONG_SHAPE);
}

static void test_camera(void)
{
    const char *what = "camera";
    uint8_t bytes[32];
    begin();
    struct writer w = {bytes, sizeof bytes, 0, false};
    put_uint(&w, 1, 1);
    put_uint(&w, 2, 5);
    ask(&camera.line, CAMERA_CONTROL, &w);
    CHECK(what, answers[0].type == ACK && number(0, 2) == TOO_LATE);
    w.size = 0;
    put_uint(&w, 1, 1);
    put_uint(&w, 2, 100);
    put_uint(&w, 3, 2);
    ask(&camera.line, CAMERA_CONTROL, &w);
    CHECK(what, number(0, 2) == OK);
    tick(200);
    ask(&camera.line, CAMERA_CONTROL, &w); /* the same again */
    CHECK(what, number(0, 2) == OK);
    camera.line.out_size = 0;
    tick(2000);
    collect(&camera.line);
    CHECK(what, n_answers == 4); /* two exposures, each with its truth */
    CHECK(what, answers[2].type == FRAME_CHUNK && number(2, 1) == 2 && number(2, 6) == 300 && number(2, 7) == 499);
    CHECK(what, number(2, 9) == 500000000 && number(2, 10) == 80 && answers[3].type == TRUTH_CHUNK);
    ask(&camera.line, PARK, &w);
    CHECK(what, n_answers == 1 && answers[0].type == ACK && number(0, 2) == NOT_SUPPORTED);
    ask_numbers(&camera.line, IDENTIFY, 80, 0); /* another session: the frames' ids go on */
    w.size = 0;
    put_uint(&w, 1, 1);
    put_uint(&w, 2, camera.step + 1);
    ask(&camera.line, CAMERA_CONTROL, &w);
    camera.line.out_size = 0;
    tick(201);
    collect(&camera.line);
    CHECK(what, n_answers == 2 && answers[0].type == FRAME_CHUNK && number(0, 1) == 3);
}

int main(void)
{
    CHECK("schema_hash", same(schema_hash, (const uint8_t *)SCHEMA_HASH, sizeof SCHEMA_HASH - 1));
    test_good();
    test_another_version();
    test_broken();
    test_parts();
    test_codec();
    test_blocks();
    test_watchdog();
    test_history();
    test_duplicates();
    test_block_in_parts();
    test_camera();
    printf("%zu good, %zu broken, %zu in parts, and the devices' states: %d checks hold\n", N(good), N(broken),
           N(in_parts), checks);
    return 0;
}
