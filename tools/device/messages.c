#include "messages.h"

#include <string.h>

/* A double goes as its eight bytes: it must be the IEEE 754 one (not so with avr-gcc's default, for example). */
typedef char double_has_eight_bytes[sizeof(double) == 8 ? 1 : -1];

enum wire { VARINT = 0, EIGHT_BYTES = 1, LENGTH = 2, FOUR_BYTES = 5 };

bool type_is_known(uint32_t type)
{
    return (type >= IDENTIFY && type <= REARM) || type == TRUTH_CHUNK || type == VIRTUAL_TIME;
}

static void put_raw(struct writer *writer, const void *bytes, size_t size)
{
    if (writer->overflow || size > writer->room - writer->size) {
        writer->overflow = true;
        return;
    }
    if (size > 0)
        memcpy(writer->bytes + writer->size, bytes, size);
    writer->size += size;
}

static void put_varint(struct writer *writer, uint64_t value)
{
    uint8_t bytes[10];
    size_t size = 0;
    do {
        bytes[size++] = (uint8_t)((value & 127) | (value > 127 ? 128 : 0));
        value >>= 7;
    } while (value > 0);
    put_raw(writer, bytes, size);
}

void put_uint(struct writer *writer, uint32_t field, uint64_t value)
{
    if (value != 0) {
        put_varint(writer, field << 3 | VARINT);
        put_varint(writer, value);
    }
}

void put_bytes(struct writer *writer, uint32_t field, const void *bytes, size_t size)
{
    if (size > 0) {
        put_varint(writer, field << 3 | LENGTH);
        put_varint(writer, size);
        put_raw(writer, bytes, size);
    }
}

void put_text(struct writer *writer, uint32_t field, const char *text)
{
    put_bytes(writer, field, text, strlen(text));
}

static void put_eight_bytes(struct writer *writer, double value)
{
    uint64_t bits;
    uint8_t bytes[8];
    memcpy(&bits, &value, sizeof bits);
    for (int i = 0; i < 8; i++)
        bytes[i] = (uint8_t)(bits >> 8 * i);
    put_raw(writer, bytes, sizeof bytes);
}

void put_double(struct writer *writer, uint32_t field, double value)
{
    put_varint(writer, field << 3 | EIGHT_BYTES);
    put_eight_bytes(writer, value);
}

void put_doubles(struct writer *writer, uint32_t field, const double *values, size_t n)
{
    if (n > 0) {
        put_varint(writer, field << 3 | LENGTH);
        put_varint(writer, 8 * n);
    }
    for (size_t i = 0; i < n; i++)
        put_eight_bytes(writer, values[i]);
}

struct reader reader_of(const uint8_t *bytes, size_t size)
{
    struct reader reader = {.at = bytes, .left = size};
    return reader;
}

static uint64_t take_varint(struct reader *reader)
{
    uint64_t value = 0;
    for (unsigned shift = 0; shift < 70 && reader->left > 0; shift += 7) {
        uint8_t byte = *reader->at++;
        reader->left--;
        value |= (uint64_t)(byte & 127) << shift; /* the tenth byte's bits beyond 64 are dropped, as protobuf does */
        if (byte < 128)
            return value;
    }
    reader->bad = true;
    return 0;
}

static uint64_t little_endian(const uint8_t *bytes, size_t size)
{
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | bytes[size];
    return value;
}

bool next_field(struct reader *reader)
{
    if (reader->left == 0)
        return false;
    uint64_t key = take_varint(reader);
    reader->field = (uint32_t)(key >> 3);
    reader->wire = (uint32_t)(key & 7);
    reader->size = reader->wire == EIGHT_BYTES ? 8 : reader->wire == FOUR_BYTES ? 4 : 0;
    if (reader->wire == VARINT) {
        reader->value = take_varint(reader);
    } else if (reader->wire == LENGTH) {
        uint64_t size = take_varint(reader);
        reader->bad |= size > reader->left;
        reader->size = reader->bad ? 0 : (size_t)size;
    } else if (reader->size == 0 || reader->size > reader->left) {
        reader->bad = true;
    }
    if (reader->bad || key >> 32 != 0 || reader->field == 0) {
        reader->bad = true;
        return false;
    }
    if (reader->wire == EIGHT_BYTES || reader->wire == FOUR_BYTES)
        reader->value = little_endian(reader->at, reader->size);
    reader->bytes = reader->at;
    reader->at += reader->size;
    reader->left -= reader->size;
    return true;
}

static bool is(const struct reader *reader, uint32_t field, enum wire wire)
{
    return reader->field == field && reader->wire == wire;
}

/* Numbers of 32 bits take the lower half of a longer one, as protobuf does. */
static void get32(const struct reader *reader, uint32_t field, uint32_t *value)
{
    if (is(reader, field, VARINT))
        *value = (uint32_t)reader->value;
}

static void get64(const struct reader *reader, uint32_t field, uint64_t *value)
{
    if (is(reader, field, VARINT))
        *value = reader->value;
}

bool identify_decode(uint64_t *nonce, const uint8_t *bytes, size_t size)
{
    struct reader reader = reader_of(bytes, size);
    *nonce = 0;
    while (next_field(&reader))
        get64(&reader, 1, nonce);
    return !reader.bad;
}

static void take_double(struct command_block *block, double *u, size_t room, uint64_t bits)
{
    if (block->n_u < room)
        memcpy(&u[block->n_u], &bits, sizeof bits);
    block->n_u++;
}

bool command_block_decode(struct command_block *block, double *u, size_t room, const uint8_t *bytes, size_t size)
{
    struct reader reader = reader_of(bytes, size);
    memset(block, 0, sizeof *block);
    while (next_field(&reader)) {
        get64(&reader, 1, &block->block_id);
        get64(&reader, 2, &block->first_step);
        get32(&reader, 3, &block->n_steps);
        get64(&reader, 5, &block->cause_frame_id);
        /* Packed, as the page says, or one by one: protobuf asks a reader to take both. */
        if (is(&reader, 4, EIGHT_BYTES))
            take_double(block, u, room, reader.value);
        if (is(&reader, 4, LENGTH)) {
            reader.bad |= reader.size % 8 != 0;
            for (size_t i = 0; i + 8 <= reader.size; i += 8)
                take_double(block, u, room, little_endian(reader.bytes + i, 8));
        }
    }
    return !reader.bad;
}

bool camera_control_decode(struct camera_control *control, const uint8_t *bytes, size_t size)
{
    struct reader reader = reader_of(bytes, size);
    memset(control, 0, sizeof *control);
    while (next_field(&reader)) {
        if (is(&reader, 1, VARINT))
            control->run = reader.value != 0;
        get64(&reader, 2, &control->first_step);
        get32(&reader, 3, &control->exposures);
    }
    return !reader.bad;
}

bool clock_query_decode(struct clock_query *query, const uint8_t *bytes, size_t size)
{
    struct reader reader = reader_of(bytes, size);
    uint64_t host_send_ns = 0;
    query->query_id = 0;
    while (next_field(&reader)) {
        get32(&reader, 1, &query->query_id);
        get64(&reader, 2, &host_send_ns);
    }
    query->host_send_ns = (int64_t)host_send_ns;
    return !reader.bad;
}

bool part_decode(struct part *part, const uint8_t *bytes, size_t size)
{
    struct reader reader = reader_of(bytes, size);
    memset(part, 0, sizeof *part);
    while (next_field(&reader)) {
        get32(&reader, 1, &part->type);
        get32(&reader, 2, &part->offset);
        get32(&reader, 3, &part->total);
        if (is(&reader, 4, LENGTH)) {
            part->data = reader.bytes;
            part->size = reader.size;
        }
    }
    return !reader.bad;
}

bool applied_query_decode(struct applied_query *query, const uint8_t *bytes, size_t size)
{
    struct reader reader = reader_of(bytes, size);
    memset(query, 0, sizeof *query);
    while (next_field(&reader)) {
        get64(&reader, 1, &query->first_step);
        get32(&reader, 2, &query->n_steps);
    }
    return !reader.bad;
}

void command_ack_encode(struct writer *writer, const struct command_ack *ack)
{
    put_uint(writer, 1, ack->block_id);
    put_uint(writer, 2, ack->code);
    put_text(writer, 3, ack->text);
    put_uint(writer, 4, ack->late_steps);
    put_uint(writer, 5, ack->superseded_steps);
    put_uint(writer, 6, ack->queue_end_step);
    put_uint(writer, 7, ack->sequence);
}

void applied_encode(struct writer *writer, const struct applied *applied, const double *u, size_t n_u)
{
    put_uint(writer, 1, applied->block_id);
    put_uint(writer, 2, applied->first_step);
    put_uint(writer, 3, applied->n_steps);
    put_doubles(writer, 4, u, n_u);
    put_uint(writer, 5, applied->source);
    put_uint(writer, 6, (uint64_t)applied->device_ns);
}

void ack_encode(struct writer *writer, uint32_t sequence, enum code code, const char *text, uint64_t step)
{
    put_uint(writer, 1, sequence);
    put_uint(writer, 2, code);
    put_text(writer, 3, text);
    put_uint(writer, 4, step);
}

void frame_chunk_encode(struct writer *writer, const struct frame_chunk *chunk)
{
    put_uint(writer, 1, chunk->frame_id);
    put_uint(writer, 2, chunk->offset);
    put_uint(writer, 3, chunk->total);
    put_uint(writer, 4, chunk->width);
    put_uint(writer, 5, chunk->height);
    put_uint(writer, 6, chunk->first_step);
    put_uint(writer, 7, chunk->last_step);
    put_uint(writer, 8, (uint64_t)chunk->exposure_start_ns);
    put_uint(writer, 9, (uint64_t)chunk->exposure_end_ns);
    put_bytes(writer, 10, chunk->data, chunk->size);
    put_uint(writer, 11, chunk->exposure_offset_ns);
    put_uint(writer, 12, chunk->plane);
}

void clock_reply_encode(struct writer *writer, const struct clock_query *query, int64_t receive_ns, int64_t send_ns)
{
    put_uint(writer, 1, query->query_id);
    put_uint(writer, 2, (uint64_t)query->host_send_ns);
    put_uint(writer, 3, (uint64_t)receive_ns);
    put_uint(writer, 4, (uint64_t)send_ns);
}

void event_encode(struct writer *writer, enum level level, int64_t device_ns, const char *text)
{
    put_uint(writer, 1, level);
    put_uint(writer, 2, (uint64_t)device_ns);
    put_text(writer, 3, text);
}

void part_encode(struct writer *writer, const struct part *part)
{
    put_uint(writer, 1, part->type);
    put_uint(writer, 2, part->offset);
    put_uint(writer, 3, part->total);
    put_bytes(writer, 4, part->data, part->size);
}

void truth_chunk_encode(struct writer *writer, uint64_t frame_id, const struct part *piece)
{
    put_uint(writer, 1, frame_id);
    put_uint(writer, 2, piece->offset);
    put_uint(writer, 3, piece->total);
    put_bytes(writer, 4, piece->data, piece->size);
}
