/* Bytes into both devices, which the sanitisers watch: with clang and -fsanitize=fuzzer as its target, otherwise for
 * `fuzz SECONDS [SEED]` with its own mutations of the good vectors. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "camera.h"
#include "mirror.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static struct rig rig;
static struct mirror mirror;
static struct camera camera;

static void require(bool holds)
{
    if (!holds)
        abort();
}

/* What a device sends is packets of its own version, and its reports follow each other. */
static void drain(struct line *line)
{
    static struct decoder decoder;
    struct packet packet;
    require(line->out_size <= OUT_BYTES);
    memset(&decoder, 0, sizeof decoder);
    for (size_t i = 0; i < line->out_size; i++)
        if (decoder_take(&decoder, line->out[i], &packet)) {
            struct reader reader = reader_of(packet.payload, packet.size);
            while (next_field(&reader)) {
            }
            require(packet.version == PROTOCOL_VERSION && type_is_known(packet.type) && !reader.bad);
        }
    require(decoder.bad_crc == 0 && decoder.bad_framing == 0 && decoder.code == 0);
    line_sent(line, line->out_size);
}

static void tick(unsigned steps)
{
    for (; steps > 0; steps--) {
        mirror_tick(&mirror);
        camera_tick(&camera);
        mirror_watchdog(&mirror, (int64_t)mirror.step * FAST_STEP_NS);
        for (int i = 0; i < N_INPUTS; i++) {
            double u = mirror.ring[mirror.step % RING_STEPS].u[i];
            require(u >= INPUT_MIN - 1e-12 && u <= INPUT_MAX + 1e-12);
        }
        require(mirror.queue_end > mirror.step && mirror.queue_end <= mirror.step + 1 + QUEUE_STEPS);
    }
}

static void take(bool is_mirror, uint8_t byte)
{
    int64_t now_ns = (int64_t)mirror.step * FAST_STEP_NS;
    if (is_mirror)
        mirror_take(&mirror, byte, now_ns);
    else
        camera_take(&camera, byte, now_ns);
}

/* Reads the data as what a host does: a byte says what comes next, raw bytes, a packet with the right checksum around
 * any payload, a CommandBlock near the present, or time that goes by. */
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static uint8_t buffer[MAX_MESSAGE];
    static struct decoder decoder;
    struct parts parts = {.bytes = buffer, .room = 100000};
    struct packet packet;
    uint16_t sequence = 0;
    uint8_t wire[MAX_WIRE], payload[256];

    rig_begin_at_rest(&rig, 1);
    mirror_begin(&mirror, &rig, 0);
    camera_begin(&camera, &rig, 0);
    memset(&decoder, 0, sizeof decoder);
    for (size_t i = 0; i < size; i++)
        if (decoder_take(&decoder, data[i], &packet))
            parts_take(&parts, &packet);
    while (size >= 3) {
        uint8_t what = data[0], type = data[1];
        size_t n = data[2] < size - 3 ? data[2] : size - 3;
        bool is_mirror = what & 1;
        data += 3;
        size -= 3;
        struct writer w = {payload, sizeof payload, 0, false};
        if ((what >> 1 & 3) == 0) {
            for (size_t i = 0; i < n; i++)
                take(is_mirror, data[i]);
        } else if ((what >> 1 & 3) == 1) {
            tick(type * 8u);
            n = 0;
        } else {
            size_t wire_size;
            if ((what >> 1 & 3) == 2) {
                wire_size = packet_encode(wire, type, sequence++, data, n);
            } else {
                double u[8] = {INPUT_MIN, INPUT_MAX, 0.001, -0.001, 0.0, 0.01, 0.02, 0.03};
                put_uint(&w, 1, what >> 3);
                put_uint(&w, 2, mirror.step + type * 2u - 8u);
                put_uint(&w, 3, n % 8);
                put_doubles(&w, 4, u, n % 8);
                wire_size = packet_encode(wire, COMMAND_BLOCK, sequence++, payload, w.size);
                n = 0;
            }
            for (size_t i = 0; i < wire_size; i++)
                take(is_mirror, wire[i]);
        }
        data += n;
        size -= n;
        if (what & 128) {
            drain(&mirror.line);
            drain(&camera.line);
        }
    }
    drain(&mirror.line);
    drain(&camera.line);
    return 0;
}

#ifndef LIBFUZZER
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
#define GOOD_ONLY
#include "vectors.h"

static uint64_t state;

static uint32_t random_below(uint32_t n)
{
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (uint32_t)(state >> 33) % n;
}

int main(int argc, char **argv)
{
    static uint8_t data[8192];
    double seconds = argc > 1 ? atof(argv[1]) : 60.0;
    unsigned long runs = 0;
    time_t end = time(NULL) + (time_t)seconds;
    state = argc > 2 ? strtoull(argv[2], NULL, 10) : 1;
    for (; time(NULL) < end; runs++) {
        size_t size = 0;
        for (uint32_t pieces = 1 + random_below(12); pieces > 0 && size < sizeof data - 800; pieces--) {
            const struct good *vector = &good[random_below(sizeof good / sizeof good[0])];
            bool whole = random_below(2);
            const struct bytes *bytes = whole ? &vector->wire : &vector->payload;
            size_t n = bytes->size < 255 ? bytes->size : 255;
            data[size++] = (uint8_t)((whole ? 0 : 4) | random_below(2) | random_below(4) << 1 | random_below(2) << 7);
            data[size++] = random_below(4) ? vector->type : (uint8_t)random_below(256);
            data[size++] = (uint8_t)n;
            memcpy(data + size, bytes->bytes, n);
            size += n;
        }
        for (uint32_t changes = random_below(8); changes > 0; changes--)
            data[random_below((uint32_t)size)] = (uint8_t)random_below(256);
        LLVMFuzzerTestOneInput(data, size);
    }
    printf("%lu inputs, nothing found\n", runs);
    return 0;
}
#endif
