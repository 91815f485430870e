/* The messages of aolink/wire/messages.proto that a device needs, and as much of protobuf. Fields have the schema's
 * names and units. Decoders skip fields that they do not know; encoders leave out zeros, as proto3 does. */
#ifndef MESSAGES_H
#define MESSAGES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum type {
    IDENTIFY = 1,
    IDENTITY = 2,
    COMMAND_BLOCK = 3,
    COMMAND_ACK = 4,
    APPLIED = 5,
    CAMERA_CONTROL = 6,
    PARK = 7,
    ACK = 8,
    FRAME_CHUNK = 9,
    CLOCK_QUERY = 10,
    CLOCK_REPLY = 11,
    EVENT = 12,
    PART = 13,
    APPLIED_QUERY = 14,
    REARM = 15,
    TRUTH_CHUNK = 120,
    VIRTUAL_TIME = 121
};

bool type_is_known(uint32_t type);

enum code { OK, OUT_OF_RANGE, WRONG_SHAPE, QUEUE_FULL, NOT_SUPPORTED, TOO_LATE, LATCHED };
enum kind { KIND_UNKNOWN, KIND_CAMERA, KIND_MIRROR };
enum source { SOURCE_COMMAND, SOURCE_PARKED, SOURCE_CLIPPED, SOURCE_WATCHDOG, SOURCE_NOT_REPORTED };
enum level { LEVEL_INFO, LEVEL_WARNING, LEVEL_ERROR };

/* The first 8 bytes of the SHA-256 of messages.proto without comments and white space; `make test` compares. */
#define SCHEMA_HASH "\x65\xa5\x4d\x90\xa2\xee\x99\xd7"

/* A payload being written. When it does not fit, `overflow` is set and nothing more is written. */
struct writer {
    uint8_t *bytes;
    size_t room, size;
    bool overflow;
};

void put_uint(struct writer *writer, uint32_t field, uint64_t value); /* uint32, uint64, int64, bool, enum */
void put_bytes(struct writer *writer, uint32_t field, const void *bytes, size_t size);
void put_text(struct writer *writer, uint32_t field, const char *text);
void put_double(struct writer *writer, uint32_t field, double value);
void put_doubles(struct writer *writer, uint32_t field, const double *values, size_t n); /* packed */

/* What is left of a payload, and the field in front of it. */
struct reader {
    const uint8_t *at;
    size_t left;
    bool bad; /* it is no protobuf message */
    uint32_t field, wire;
    uint64_t value;       /* of a number */
    const uint8_t *bytes; /* of text, bytes, packed numbers */
    size_t size;
};

struct reader reader_of(const uint8_t *bytes, size_t size);
bool next_field(struct reader *reader); /* false at the end, and where the payload makes no sense */

struct command_block {
    uint64_t block_id, first_step, cause_frame_id;
    uint32_t n_steps;
    size_t n_u; /* all that came, even where they were too many to keep */
};

struct command_ack {
    uint64_t block_id, queue_end_step;
    uint32_t code, late_steps, superseded_steps, sequence;
    const char *text;
};

struct applied {
    uint64_t block_id, first_step;
    uint32_t n_steps, source;
    int64_t device_ns;
};

struct camera_control {
    uint64_t first_step;
    uint32_t exposures;
    bool run;
};

struct frame_chunk {
    uint64_t frame_id, first_step, last_step;
    uint32_t offset, total, width, height, exposure_offset_ns, plane;
    int64_t exposure_start_ns, exposure_end_ns;
    const uint8_t *data;
    size_t size;
};

struct clock_query {
    uint32_t query_id;
    int64_t host_send_ns;
};

struct part {
    uint32_t type, offset, total;
    const uint8_t *data;
    size_t size;
};

struct applied_query {
    uint64_t first_step;
    uint32_t n_steps;
};

/* Decoders are false for a payload that is no protobuf message. `u` takes the first `room` inputs of a block. */
bool identify_decode(uint64_t *nonce, const uint8_t *bytes, size_t size);
bool command_block_decode(struct command_block *block, double *u, size_t room, const uint8_t *bytes, size_t size);
bool camera_control_decode(struct camera_control *control, const uint8_t *bytes, size_t size);
bool clock_query_decode(struct clock_query *query, const uint8_t *bytes, size_t size);
bool part_decode(struct part *part, const uint8_t *bytes, size_t size);
bool applied_query_decode(struct applied_query *query, const uint8_t *bytes, size_t size);

void command_ack_encode(struct writer *writer, const struct command_ack *ack);
void applied_encode(struct writer *writer, const struct applied *applied, const double *u, size_t n_u);
void ack_encode(struct writer *writer, uint32_t sequence, enum code code, const char *text, uint64_t step);
void frame_chunk_encode(struct writer *writer, const struct frame_chunk *chunk);
void clock_reply_encode(struct writer *writer, const struct clock_query *query, int64_t receive_ns, int64_t send_ns);
void event_encode(struct writer *writer, enum level level, int64_t device_ns, const char *text);
void part_encode(struct writer *writer, const struct part *part);
void truth_chunk_encode(struct writer *writer, uint64_t frame_id, const struct part *piece);

#endif
