/* Exchange kernel: reads and writes of one cycle, for all serial lines of a robot.
 *
 * It executes a plan of flat structs that `kernel.py` lays out: the bytes to send, the expected replies, and the
 * destination of their data. It writes, waits, reads, verifies, timestamps, appends to the packet log, fills the
 * states, and turns goals into sync writes. Any deviation from the plan ends the call with UNEXPECTED. The bytes
 * received until then stay in the line's buffer, and the packet-by-packet parser in Python continues with them.
 *
 * All lengths come from the plan, none from the wire, so a corrupted packet cannot overrun a buffer. Build with
 * -ffp-contract=off: fused multiply-add would change the last bits between machines.
 */

#define _GNU_SOURCE
#include <errno.h>
#include <math.h>
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#ifdef __linux__
#include <poll.h>
#else /* elsewhere robots run on virtual time only, where no line has a file descriptor */
#define POLLIN 1
#define POLLOUT 4
struct pollfd { int fd; short events, revents; };
typedef unsigned nfds_t;
#define ppoll(set, count, timeout, mask) ((void)(set), (void)(count), (void)(timeout), 0)
#endif

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: kernel.py rejects an object of another version, as structs may differ */
#endif
#define MOST_LINES 256 /* a packet record stores the bus in one byte: packets.py */
#define MOST_PIECES 32
#define LONGEST_SYNC_WRITE 6200
#define RECORD_HEADER 24 /* bus, kind, ID, pad, length, two times: packets.py */
#define REPEATED 50      /* cycles after which an unchanged goal is sent again: a sync write has no acknowledgement */
#define NEVER ((int64_t)1 << 62)
#define LOST_LINE_STEP_NS 200000  /* same value as in bus_engine.py */
#define WRITE_TIMEOUT_NS 20000000 /* same value as _WRITE_TIMEOUT_NS in ports.py */
#define LEAST_NAP_NS 15000        /* a shorter sleep is not worth its wake-up; the time is polled instead */

enum { OK, WAITING, FULL, UNEXPECTED, LOOK, SILENCE };
enum { IDLE, AWAITING, THROUGH };
enum { FREE_NS, LATE_NS, LOST, ASKED_NS, SILENCE_NS }; /* words of a line, shared with the parser: bus.py */
#define MOST_LATE_NS 1000000     /* same value as in bus.py */
enum { INSTRUCTION = 1, STATUS = 2 };
enum { UNSIGNED, TWOS_COMPLEMENT, SIGN_MAGNITUDE, FLOAT32 };

typedef struct {
    int32_t offset, size, encoding;
    int32_t bit; /* index of the single bit that counts; -1: the whole number */
} Field;

typedef struct { /* one servo: position of its state in the reply data, and its row in the states */
    Field fields[3];
    int64_t row;
    double quick; /* rad; a step up to this is always plausible */
} Servo;

typedef struct { /* one state of a device: number * scale + offset, stored in its column of the source states */
    Field field;
    double scale, offset;
    int64_t column;
} DeviceField;

typedef struct { /* block of a device's items that one read fetches */
    int32_t first_field, field_count;
} Block;

typedef struct { /* one device, with its row in the sources */
    int32_t first_block, block_count;
    int64_t row;
} Device;

typedef struct { /* reply data of one servo, or of one block of a device; blocks are numbered after the servos */
    int32_t servo, data_at, end, unused; /* `end`: offset after the checksum */
} Part;

typedef struct { /* one status packet of the replies */
    int32_t start, end, id, unused;
} Packet;

typedef struct { /* one read instruction and its replies, to the byte */
    const uint8_t *instruction;
    const uint8_t *expected; /* expected bytes of the replies */
    const uint8_t *known;    /* 0xff for each byte of `expected` that must match, 0 for data and checksums */
    const Packet *packets;
    const Part *parts;
    int32_t instruction_size, size, packet_count, part_count, id, fast;
    int32_t firm_size, unused; /* bytes after which only devices are still awaited; 0: the read has no devices */
    int64_t due_ns, timeout_ns, tail_timeout_ns, tail_margin_ns, least_ns, record_bytes;
} Read;

typedef struct { /* one goal item of one servo: goals.GoalCell */
    int32_t at, size, interface, magnitude, mirrored, low, high, free;
    double sign, offset, unit;
} Cell;

typedef struct { /* goals.SyncWrite */
    const int32_t *members; /* indices on the bus */
    const int32_t *rows;
    const uint8_t *ids;
    const Cell *cells; /* `items` cells per servo, one servo after the other */
    int32_t *ticks;
    uint8_t *again;  /* 1 if the goal changed in the previous cycle */
    uint8_t *served; /* 1 if the servo could get a goal in the previous cycle */
    int64_t *sent_at;
    int64_t cycle;
    int32_t count, items, address, length;
    int32_t lead, leads; /* goals that must be numbers: `leads` rows from `lead` on */
    int32_t always;      /* 1: every goal is sent by every call, changed or not */
} SyncWrite;

typedef struct {
    int64_t at_ns;
    int32_t end, unused;
} Piece;

typedef struct { /* one serial line */
    const Read *reads;
    SyncWrite *writes;
    const uint8_t *included; /* 1 for each servo that may get goals */
    const double *ceiling;   /* speed limit of each servo, rad/s; NaN: no limit */
    uint8_t *buffer;
    int64_t *words;
    int64_t byte_ns, latency_ns, sent_ns, due_ns, deadline_ns, at_ns;
    int32_t descriptor, bus, protocol, planned;
    int32_t first_servo, servo_count, first_block, block_count;
    int32_t room, read_count, write_count;
    int32_t state, done, have, pieces;
    int32_t gone; /* errno of a failed write, or -1; 0: no write has failed */
    Piece piece[MOST_PIECES];
} Line;

typedef struct { /* polling for replies shortly before they are due: ReplyPolling in ports.py */
    double share, credit_ns;
    int64_t longest_ns, updated_ns, late_ns, step_ns, margin_ns, saved_ns;
    int32_t enabled, slept;
} Polling;

typedef struct { /* functions of ports without file descriptors, as on virtual time: ports.py */
    void *context; /* first argument of each function */
    int64_t (*now)(void *context);
    int32_t (*send)(void *context, int32_t line, const uint8_t *data, int32_t size);    /* -1: the line is gone */
    int32_t (*receive)(void *context, int32_t line, uint8_t *data, int32_t room);       /* bytes; -1: it is gone */
    int32_t (*wait)(void *context, int64_t deadline_ns, uint8_t *ready); /* number of readable lines */
    void (*sleep)(void *context, int64_t until_ns);
} PortFunctions;

typedef struct Kernel {
    Line *lines;
    const Servo *servos;
    double *values;
    const double *scale, *reference;
    uint8_t *fresh, *doubted;
    int64_t *at_ns, *shown_ns;
    double *position, *velocity, *effort;
    uint8_t *valid;
    int64_t *age_ns;
    const Device *devices;
    const Block *blocks;
    const DeviceField *fields;
    double *device_values;
    uint8_t *block_fresh, *device_doubted;
    int64_t *block_at_ns, *device_shown_ns;
    double *source_values;
    uint8_t *source_valid;
    int64_t *source_age_ns;
    const double *goals[4];
    uint8_t *desk; /* log batch that is not committed yet; NULL: no log */
    uint64_t *used;
    int64_t desk_room, reserved, beat_ns;
    const PortFunctions *ports; /* NULL: the lines have file descriptors */
    int32_t line_count, servo_count, write_line, write_number, device_count;
    int32_t raised; /* 1 after one of these functions raised an exception: every call then fails */
    Polling polling;
} Kernel;

/* System calls: used unless the Python side provides its own functions, as on virtual time */

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int64_t now_ns(const Kernel *k) { return k->ports ? k->ports->now(k->ports->context) : clock_ns(); }

static int is_read(const Line *l) { return l->planned && !l->words[LOST]; }

/* Wait for bytes on any line of ports without file descriptors. */
static int32_t wait_for_ports(Kernel *k, int64_t deadline_ns, uint8_t *ready)
{
    const PortFunctions *ports = k->ports;
    int32_t heard = ports->wait(ports->context, deadline_ns, ready), found = 0;
    for (int32_t i = 0; i < k->line_count; i++) {
        ready[i] = ready[i] && is_read(&k->lines[i]);
        found += ready[i];
    }
    if (heard && !found) { /* a lost line is always readable: let time pass */
        int64_t step = ports->now(ports->context) + LOST_LINE_STEP_NS;
        ports->sleep(ports->context, step < deadline_ns ? step : deadline_ns);
    }
    return found;
}

/* Wait for bytes on any line. `ready` has one flag per line. Return the number of readable lines. */
static int32_t wait_for(Kernel *k, int64_t deadline_ns, uint8_t *ready)
{
    struct pollfd set[MOST_LINES];
    int32_t line[MOST_LINES], count = 0, found = 0;
    memset(ready, 0, (size_t)k->line_count);
    if (k->ports)
        return wait_for_ports(k, deadline_ns, ready);
    for (int32_t i = 0; i < k->line_count; i++)
        if (is_read(&k->lines[i])) {
            set[count] = (struct pollfd){k->lines[i].descriptor, POLLIN, 0};
            line[count++] = i;
        }
    int64_t left = deadline_ns ? deadline_ns - clock_ns() : 0;
    if (left < 0)
        left = 0;
    struct timespec timeout = {left / 1000000000, left % 1000000000};
    if (ppoll(set, (nfds_t)count, &timeout, NULL) <= 0)
        return 0;
    for (int32_t i = 0; i < count; i++)
        if (set[i].revents) {
            ready[line[i]] = 1;
            found++;
        }
    return found;
}

/* Write one whole packet to a line. Return false when the line is gone or accepts no more bytes. */
static int send_all(Kernel *k, Line *l, const uint8_t *data, int32_t size)
{
    if (k->ports) {
        l->gone = k->ports->send(k->ports->context, (int32_t)(l - k->lines), data, size) < 0 ? -1 : 0;
        return !l->gone;
    }
    int64_t deadline = 0;
    while (size > 0) {
        ssize_t count = write(l->descriptor, data, (uint32_t)size);
        if (count < 0 && errno != EAGAIN && errno != EINTR) {
            l->gone = errno;
            return 0;
        }
        if (count > 0) {
            data += count;
            size -= (int32_t)count;
            continue;
        }
        /* The output queue is full. Packets are short, so a queue that stays full belongs to a stuck line. */
        if (!deadline)
            deadline = clock_ns() + WRITE_TIMEOUT_NS;
        int64_t left = deadline - clock_ns();
        if (left <= 0) {
            l->gone = -1;
            return 0;
        }
        struct pollfd one = {l->descriptor, POLLOUT, 0};
        struct timespec timeout = {0, (long)left};
        ppoll(&one, 1, &timeout, NULL);
    }
    return 1;
}

/* Return the number of bytes read, 0 if none, -1 if the line is gone. Readable without data (EOF) counts as gone. */
static int32_t receive(Kernel *k, Line *l)
{
    uint8_t *place = l->buffer + l->have;
    int32_t room = l->room - l->have;
    if (k->ports)
        return k->ports->receive(k->ports->context, (int32_t)(l - k->lines), place, room);
    ssize_t count = read(l->descriptor, place, (uint32_t)room);
    if (count > 0)
        return (int32_t)count;
    return count < 0 && (errno == EAGAIN || errno == EINTR) ? 0 : -1;
}

/* The log */

static int has_room(const Kernel *k, int64_t bytes)
{
    /* `reserved` is the space for replies that are still awaited: they must fit without a commit. */
    return !k->desk || (int64_t)*k->used + k->reserved + bytes <= k->desk_room;
}

static void put_record(Kernel *k, const Line *l, int32_t kind, int32_t id, int64_t first, int64_t last,
                       const uint8_t *data, int32_t size)
{
    if (!k->desk)
        return;
    uint8_t *to = k->desk + *k->used;
    uint8_t head[8] = {(uint8_t)l->bus, (uint8_t)kind, (uint8_t)id, 0};
    uint32_t length = (uint32_t)size;
    memcpy(head + 4, &length, 4);
    memcpy(to, head, 8);
    memcpy(to + 8, &first, 8);
    memcpy(to + 16, &last, 8);
    memcpy(to + RECORD_HEADER, data, (size_t)size);
    /* Publish the record last: if the process dies here, the reader must not see a partial record. */
    atomic_signal_fence(memory_order_release);
    *(volatile uint64_t *)k->used += (uint64_t)(RECORD_HEADER + size);
}

/* Checksums: e-Manual, Protocol 1.0 (checksum) and 2.0 (CRC-16, polynomial 8005, not reflected, from 0) */

static uint16_t crc_table[256];

__attribute__((constructor)) static void fill_crc_table(void)
{
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t crc = i << 8;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 0x8000 ? crc << 1 ^ 0x8005 : crc << 1;
        crc_table[i] = (uint16_t)crc;
    }
}

static uint16_t crc16(uint16_t crc, const uint8_t *data, int32_t size)
{
    for (int32_t i = 0; i < size; i++)
        crc = (uint16_t)(crc << 8 ^ crc_table[(crc >> 8 ^ data[i]) & 0xff]);
    return crc;
}

static int crc_is_right(uint16_t crc, const uint8_t *tail) { return crc == (tail[0] | tail[1] << 8); }

/* Verify the checksums of the replies that end within the first `bytes` bytes. */
static int sums_are_right(const Line *l, const Read *r, int32_t bytes)
{
    const uint8_t *b = l->buffer;
    if (r->fast) { /* each CRC continues from the previous one and covers that CRC as well */
        uint16_t crc = 0;
        int32_t from = 0;
        for (int32_t i = 0; i < r->part_count; i++) {
            int32_t tail = r->parts[i].end - 2;
            crc = crc16(crc, b + from, tail - from);
            if (!crc_is_right(crc, b + tail))
                return 0;
            from = tail;
        }
        return 1;
    }
    for (int32_t i = 0; i < r->packet_count && r->packets[i].end <= bytes; i++) {
        int32_t start = r->packets[i].start, end = r->packets[i].end;
        if (l->protocol == 1) {
            uint8_t sum = 0;
            for (int32_t at = start + 2; at < end; at++)
                sum = (uint8_t)(sum + b[at]);
            if (sum != 0xff)
                return 0;
        } else {
            if (!crc_is_right(crc16(0, b + start, end - 2 - start), b + end - 2))
                return 0;
            /* A reply of this length with byte stuffing has less data than was requested. */
            for (int32_t at = start + 7; at + 4 <= end; at++)
                if (b[at] == 0xff && b[at + 1] == 0xff && b[at + 2] == 0xfd && b[at + 3] == 0xfd)
                    return 0;
        }
    }
    return 1;
}

/* Reply polling */

/* Begin to await a reply. Return the time to sleep, and in `until` the end of polling; 0: no credit left. */
int64_t dxl_polling_begin(Polling *p, int64_t due_ns, int64_t now, int64_t deadline_ns, int64_t *until)
{
    *until = 0;
    p->slept = 0;
    p->credit_ns += p->share * (double)(p->updated_ns < 0 ? 0 : now - p->updated_ns);
    /* The credit is capped: a long pause must not allow a long burst of polling. */
    if (p->credit_ns > (double)p->saved_ns)
        p->credit_ns = (double)p->saved_ns;
    p->updated_ns = now;
    int64_t expected = due_ns + p->late_ns, most = (int64_t)p->credit_ns;
    if (most > p->longest_ns)
        most = p->longest_ns;
    int64_t end = expected - p->margin_ns + p->longest_ns;
    if (most < p->margin_ns || end <= now || expected >= deadline_ns)
        return 0;
    int64_t nap = expected - p->margin_ns - now;
    if (nap < LEAST_NAP_NS)
        nap = 0;
    p->slept = nap > 0;
    *until = end;
    if (*until > now + nap + most)
        *until = now + nap + most;
    if (*until > deadline_ns)
        *until = deadline_ns;
    return nap;
}

/* Charge the time spent polling, and record whether the first look was already successful. */
void dxl_polling_spent(Polling *p, int64_t duration_ns, int32_t looks)
{
    p->credit_ns -= (double)duration_ns;
    p->slept = p->slept && looks == 1;
}

/* Update the expected lateness with replies that were due at `due_ns` and seen at `at_ns`. */
void dxl_polling_came(Polling *p, int64_t due_ns, int64_t at_ns)
{
    int64_t late = at_ns - due_ns;
    if (p->slept && late >= p->late_ns - p->margin_ns) {
        /* They were there at the first look, perhaps for long: shorten the sleep until an arrival is observed. */
        late = p->late_ns - p->step_ns;
        p->step_ns *= 2;
    } else {
        p->step_ns = p->margin_ns;
        int64_t change = late - p->late_ns;
        if (change < 0)
            change = (change - 1) / 2; /* rounds down */
        else
            change = (change < p->margin_ns ? change : p->margin_ns) / 8; /* limits the influence of an outlier */
        late = p->late_ns + change;
    }
    p->late_ns = late < -2000000 ? -2000000 : late > 20000000 ? 20000000 : late;
}

/* Sleep until shortly before replies are due, then poll. Return the number of readable lines. */
static int32_t poll_for_replies(Kernel *k, int64_t deadline_ns, uint8_t *ready)
{
    int64_t now = clock_ns(), soonest = NEVER, latest = 0, until;
    for (int32_t i = 0; i < k->line_count; i++) {
        const Line *l = &k->lines[i];
        if (is_read(l) && l->state == AWAITING) {
            if (l->due_ns > latest)
                latest = l->due_ns;
            if (l->due_ns > now && l->due_ns < soonest)
                soonest = l->due_ns;
        }
    }
    int64_t nap = dxl_polling_begin(&k->polling, soonest == NEVER ? latest : soonest, now, deadline_ns, &until);
    if (!until)
        return 0;
    if (nap) {
        struct timespec length = {nap / 1000000000, nap % 1000000000};
        nanosleep(&length, NULL);
    }
    int64_t since = clock_ns();
    int32_t found = 0, looks = 0;
    for (now = since; !found && now < until; now = clock_ns()) {
        found = wait_for(k, 0, ready);
        looks++;
    }
    dxl_polling_spent(&k->polling, clock_ns() - since, looks);
    return found;
}

/* Reads */

static double tick(const Field *f, const uint8_t *data)
{
    uint32_t raw = 0;
    for (int32_t i = 0; i < f->size; i++)
        raw |= (uint32_t)data[f->offset + i] << 8 * i;
    if (f->bit >= 0)
        return raw >> f->bit & 1;
    if (f->encoding == SIGN_MAGNITUDE) /* bit 10 is the sign: e-Manual AX-12A, Present Speed (38) */
        return raw & 0x400 ? -(int32_t)(raw & 0x3ff) : (int32_t)(raw & 0x3ff); /* integers, to avoid -0.0 */
    if (f->encoding == TWOS_COMPLEMENT)
        return f->size == 1 ? (int8_t)raw : f->size == 2 ? (int16_t)raw : (int32_t)raw;
    if (f->encoding == FLOAT32) {
        float number;
        memcpy(&number, &raw, 4);
        return number;
    }
    return raw;
}

static const Piece *piece_of(const Line *l, int32_t at)
{
    const Piece *p = l->piece;
    while (p->end <= at)
        p++;
    return p;
}

static void take_block(Kernel *k, int32_t i, const uint8_t *data, int64_t at_ns)
{
    const DeviceField *f = k->fields + k->blocks[i].first_field;
    for (int32_t n = k->blocks[i].field_count; n > 0; n--, f++)
        k->device_values[f->column] = tick(&f->field, data) * f->scale + f->offset;
    k->block_fresh[i] = 1;
    k->block_at_ns[i] = at_ns;
}

/* Store the state that a member of a line, servo or device block, has sent. */
static void take_state(Kernel *k, const Line *l, int32_t member, const uint8_t *data, int64_t at_ns)
{
    if (member >= l->servo_count) {
        take_block(k, l->first_block + member - l->servo_count, data, at_ns);
        return;
    }
    int32_t i = l->first_servo + member, n = k->servo_count;
    for (int32_t f = 0; f < 3; f++)
        k->values[f * n + i] = tick(&k->servos[i].fields[f], data) * k->scale[f * n + i];
    k->values[i] -= k->reference[i];
    k->fresh[i] = 1;
    k->at_ns[i] = at_ns;
}

/* Begin a cycle of a line: mark all its states as not received. */
static void clear_fresh(Kernel *k, const Line *l)
{
    memset(k->fresh + l->first_servo, 0, (size_t)l->servo_count);
    memset(k->block_fresh + l->first_block, 0, (size_t)l->block_count);
}

/* Account for a packet written at `before`: it waits in the adapter until earlier packets are off the wire. Return
 * the time at which its first byte is on the wire. */
static int64_t occupy(Line *l, int64_t before, int32_t size)
{
    int64_t start = l->words[FREE_NS] > before ? l->words[FREE_NS] : before;
    l->words[FREE_NS] = start + size * l->byte_ns;
    return start;
}

/* Send the next read of a line. Return OK, FULL, or UNEXPECTED when the line is gone. */
static int ask(Kernel *k, Line *l)
{
    const Read *r = &l->reads[l->done];
    if (!has_room(k, r->record_bytes))
        return FULL;
    if (!l->done)
        clear_fresh(k, l);
    l->state = IDLE;
    int64_t before = now_ns(k);
    if (!send_all(k, l, r->instruction, r->instruction_size))
        return UNEXPECTED;
    int64_t after = now_ns(k);
    put_record(k, l, INSTRUCTION, r->id, before, after, r->instruction, r->instruction_size);
    k->reserved += r->record_bytes - RECORD_HEADER - r->instruction_size;
    l->sent_ns = occupy(l, before, r->instruction_size);
    l->due_ns = l->sent_ns + r->due_ns;
    /* This process may have been suspended before the bytes left. */
    l->deadline_ns = (l->sent_ns > after ? l->sent_ns : after) + r->timeout_ns;
    l->state = AWAITING;
    return OK;
}

/* Update the lateness of a line, as `Bus` does. Idle time starts no transaction that could end that late. */
static void note_lateness(Line *l, int64_t late_ns)
{
    int64_t kept = l->words[LATE_NS] - (l->words[LATE_NS] >> 6) - 1;
    if (late_ns > kept)
        kept = late_ns < MOST_LATE_NS ? late_ns : MOST_LATE_NS;
    l->words[LATE_NS] = kept > 0 ? kept : 0;
}

static int keep_replies(Kernel *k, Line *l, const Read *r, int64_t at)
{
    k->reserved -= r->record_bytes - RECORD_HEADER - r->instruction_size;
    for (int32_t i = 0; i < r->packet_count; i++) {
        const Packet *p = &r->packets[i];
        put_record(k, l, STATUS, p->id, piece_of(l, p->start)->at_ns, piece_of(l, p->end - 1)->at_ns,
                   l->buffer + p->start, p->end - p->start);
    }
    for (int32_t i = 0; i < r->part_count; i++) {
        const Part *p = &r->parts[i];
        take_state(k, l, p->servo, l->buffer + p->data_at, r->fast ? at : piece_of(l, p->end - 1)->at_ns);
    }
    if (k->polling.enabled)
        dxl_polling_came(&k->polling, l->due_ns, at);
    note_lateness(l, at - l->due_ns - l->latency_ns);
    l->at_ns = at;
    l->state = IDLE;
    l->have = l->pieces = 0;
    if (++l->done < l->read_count)
        return ask(k, l);
    l->state = THROUGH;
    return OK;
}

/* Return true for replies that came sooner than the wire allows: an echo, or replies to an earlier request. */
static int is_early(const Line *l, const Read *r)
{
    return piece_of(l, r->packets[0].end - 1)->at_ns < l->sent_ns + r->least_ns;
}

/* Shorten the deadline of the remaining replies: all servos have answered, only devices are awaited. */
static void await_devices(Line *l, const Read *r, int64_t at)
{
    int64_t brief = l->sent_ns + r->tail_timeout_ns;
    if (brief < at + r->tail_margin_ns)
        brief = at + r->tail_margin_ns;
    if (l->deadline_ns > brief)
        l->deadline_ns = brief;
}

/* Process `count` bytes that arrived on a line. Return OK, FULL, or UNEXPECTED if they differ from the plan. */
static int take(Kernel *k, Line *l, int32_t count, int64_t at)
{
    const Read *r = &l->reads[l->done];
    int32_t from = l->have;
    l->have += count;
    l->piece[l->pieces++] = (Piece){at, l->have, 0};
    /* More bytes than planned, or too many fragments to keep the time of each one: the parser takes over. */
    if (l->have > r->size || (l->have < r->size && l->pieces == MOST_PIECES))
        return UNEXPECTED;
    uint8_t wrong = 0; /* without a branch for each byte, so that the compiler compares many at once */
    for (int32_t i = from; i < l->have; i++)
        wrong |= (uint8_t)((l->buffer[i] ^ r->expected[i]) & r->known[i]);
    if (wrong)
        return UNEXPECTED;
    if (l->have < r->size) {
        if (r->firm_size && l->have >= r->firm_size &&
            (r->fast || (!is_early(l, r) && sums_are_right(l, r, r->firm_size))))
            await_devices(l, r, at);
        return OK;
    }
    if (is_early(l, r) || !sums_are_right(l, r, r->size))
        return UNEXPECTED;
    return keep_replies(k, l, r, at);
}

/* Read the bytes of a line. Bytes that arrive while no reply is awaited stay in the buffer for the parser. */
static int hear(Kernel *k, Line *l)
{
    int32_t count = receive(k, l);
    if (count < 0)
        return UNEXPECTED;
    if (!count)
        return OK;
    if (l->state == AWAITING)
        return take(k, l, count, now_ns(k));
    l->have = count;
    l->piece[l->pieces++] = (Piece){now_ns(k), count, 0};
    return UNEXPECTED;
}

/* Return true if all blocks of a device arrived in this cycle. */
static int is_whole(const Kernel *k, const Device *d)
{
    for (int32_t b = d->first_block; b < d->first_block + d->block_count; b++)
        if (!k->block_fresh[b])
            return 0;
    return 1;
}

/* Return true if all values of a device are finite. */
static int is_finite(const Kernel *k, const Device *d)
{
    for (int32_t b = d->first_block; b < d->first_block + d->block_count; b++)
        for (int32_t n = 0; n < k->blocks[b].field_count; n++)
            if (!isfinite(k->device_values[k->fields[k->blocks[b].first_field + n].column]))
                return 0;
    return 1;
}

/* Fill the states of the devices. A row is valid when all its blocks arrived and are not doubted. */
static void show_devices(Kernel *k, int64_t now)
{
    for (int32_t i = 0; i < k->device_count; i++) {
        const Device *d = &k->devices[i];
        int whole = is_whole(k, d) && !k->device_doubted[i];
        k->device_doubted[i] = 0;
        for (int32_t b = d->first_block; whole && b < d->first_block + d->block_count; b++) {
            const DeviceField *f = k->fields + k->blocks[b].first_field;
            for (int32_t n = k->blocks[b].field_count; n > 0; n--, f++)
                k->source_values[f->column] = k->device_values[f->column];
            if (b == d->first_block || k->block_at_ns[b] < k->device_shown_ns[i])
                k->device_shown_ns[i] = k->block_at_ns[b];
        }
        k->source_valid[d->row] = (uint8_t)whole;
        k->source_age_ns[d->row] = k->device_shown_ns[i] < 0 ? -1 : now - k->device_shown_ns[i];
    }
}

/* Fill the states of the robot from the replies of this cycle that are not doubted. */
void dxl_show(Kernel *k, int64_t now)
{
    int32_t n = k->servo_count;
    show_devices(k, now);
    for (int32_t i = 0; i < n; i++) {
        int64_t row = k->servos[i].row;
        int valid = k->fresh[i] && !k->doubted[i];
        k->doubted[i] = 0;
        if (valid) {
            k->position[row] = k->values[i];
            k->velocity[row] = k->values[n + i];
            k->effort[row] = k->values[2 * n + i];
        }
        k->valid[row] = (uint8_t)valid;
        k->age_ns[row] = k->at_ns[i] < 0 ? -1 : now - k->at_ns[i];
        k->shown_ns[i] = k->at_ns[i];
    }
}

/* End a cycle and fill the states. Return LOOK, with the states unchanged, if a position is further away than is
 * plausible, or if a device sent a NaN or an infinite value. */
int32_t dxl_settle(Kernel *k, int64_t now)
{
    int32_t n = k->servo_count;
    k->reserved = 0;
    for (int32_t i = 0; i < k->line_count; i++) {
        Line *l = &k->lines[i];
        l->state = IDLE;
        l->done = 0;
    }
    for (int32_t i = 0; i < n; i++)
        if (k->fresh[i] && fabs(k->values[i] - k->position[k->servos[i].row]) > k->servos[i].quick)
            return LOOK;
    for (int32_t i = 0; i < k->device_count; i++)
        if (is_whole(k, &k->devices[i]) && !is_finite(k, &k->devices[i]))
            return LOOK;
    dxl_show(k, now);
    return OK;
}

/* Store the state of a line's member that the parser received. */
void dxl_take(Kernel *k, int32_t line, int32_t member, const uint8_t *data, int64_t at_ns)
{
    take_state(k, &k->lines[line], member, data, at_ns);
}

/* Note the time of this request to the servos. Return false if a line was silent for longer than its watchdogs. */
static int is_in_time(Kernel *k, int64_t now)
{
    for (int32_t i = 0; i < k->line_count; i++) {
        const int64_t *words = k->lines[i].words;
        if (words[ASKED_NS] && words[SILENCE_NS] && now - words[ASKED_NS] > words[SILENCE_NS])
            return 0;
    }
    for (int32_t i = 0; i < k->line_count; i++)
        if (k->lines[i].words[ASKED_NS])
            k->lines[i].words[ASKED_NS] = now;
    return 1;
}

/* Return the time of the next beat. `beat_ns` may be NEVER: no overflow. */
static int64_t beat_after(const Kernel *k, int64_t now)
{
    return NEVER - now < k->beat_ns ? NEVER : now + k->beat_ns;
}

static int32_t read_all(Kernel *k)
{
    uint8_t ready[MOST_LINES];
    int64_t now = now_ns(k);
    if (!is_in_time(k, now))
        return SILENCE;
    int64_t stop = beat_after(k, now);
    int32_t idle = 0;
    for (int32_t i = 0; i < k->line_count; i++) { /* before the reads, as the parser may settle this cycle */
        const Line *l = &k->lines[i];
        if (!is_read(l))
            clear_fresh(k, l);
    }
    for (int32_t i = 0; i < k->line_count; i++)
        idle += is_read(&k->lines[i]) && k->lines[i].state == IDLE;
    if (idle && wait_for(k, 0, ready)) /* bytes from before a request must not be taken for its reply */
        for (int32_t i = 0; i < k->line_count; i++)
            if (ready[i] && is_read(&k->lines[i]) && k->lines[i].state == IDLE)
                return UNEXPECTED;
    for (int32_t i = 0; i < k->line_count; i++) {
        Line *l = &k->lines[i];
        if (is_read(l) && l->state == IDLE) {
            int answer = ask(k, l);
            if (answer != OK)
                return answer;
        }
    }
    for (;;) {
        int64_t deadline = NEVER;
        for (int32_t i = 0; i < k->line_count; i++) {
            const Line *l = &k->lines[i];
            if (is_read(l) && l->state == AWAITING && l->deadline_ns < deadline)
                deadline = l->deadline_ns;
        }
        if (deadline == NEVER)
            break;
        if (now >= stop)
            return WAITING;
        int64_t beat = beat_after(k, now), end = deadline < beat ? deadline : beat;
        int32_t found = k->polling.enabled && !k->ports ? poll_for_replies(k, end, ready) : 0;
        if (!found)
            found = wait_for(k, end, ready);
        now = now_ns(k);
        if (!found && now >= deadline && !(found = wait_for(k, 0, ready)))
            return UNEXPECTED; /* checked twice: this process may have been suspended during the wait */
        /* Read every readable line, whatever the result of the other lines. The parser does the same. */
        int answer = OK;
        for (int32_t i = 0; i < k->line_count; i++) {
            int one = ready[i] && is_read(&k->lines[i]) ? hear(k, &k->lines[i]) : OK;
            if (one > answer)
                answer = one;
        }
        if (answer != OK)
            return answer;
    }
    return dxl_settle(k, now_ns(k));
}

/* Read every servo once. Call again after WAITING (`beat_ns` has passed) and FULL (commit the log first). SILENCE:
 * nothing was sent, because watchdogs may have stopped servos. */
int32_t dxl_read(Kernel *k)
{
    int32_t answer = read_all(k);
    return k->raised ? UNEXPECTED : answer;
}

/* Goals */

static int32_t goal_tick(const Cell *c, double goal, double ceiling)
{
    if (!c->magnitude) {
        double exact = (c->sign * goal + c->offset) / c->unit;
        int32_t t = exact >= c->low && exact <= c->high ? (int32_t)rint(exact) : exact < c->low ? c->low : c->high;
        return c->mirrored && t < 0 ? 0x400 - t : t; /* bit 10: e-Manual AX-12A, Moving Speed (32) */
    }
    if (c->interface == 1 && !(isnan(ceiling) || fabs(goal) <= ceiling))
        goal = ceiling;
    double exact = fabs(goal) / c->unit;
    if (exact >= c->low && exact <= c->high) /* a speed is a limit, so it is rounded down: goals.GoalCell */
        /* 1e-6: a speed that equals a tick up to rounding errors must not become the tick below. */
        return (int32_t)(c->interface == 1 ? floor(exact + 1e-6) : rint(exact));
    return exact < c->low ? c->low : exact > c->high ? c->high : c->free;
}

/* Stuff the parameters of a packet in place: FF FF FD is followed by another FD. Return the packet's size. */
static int32_t stuff(uint8_t *packet, int32_t size)
{
    for (int32_t at = 10; at < size; at++)
        if (packet[at] == 0xfd && packet[at - 1] == 0xff && packet[at - 2] == 0xff)
            memmove(packet + at + 1, packet + at, (size_t)(size++ - at));
    return size;
}

/* Build the sync write of the goals that are due. Return its size, 0 if no goal is due. */
static int32_t build(Kernel *k, const Line *l, SyncWrite *w, uint8_t *packet)
{
    const int32_t head = l->protocol == 1 ? 7 : 12;
    int32_t size = head;
    int64_t cycle = ++w->cycle;
    for (int32_t m = 0; m < w->count; m++) {
        int32_t index = w->members[m], row = w->rows[m], *ticks = w->ticks + m * w->items;
        const Cell *cells = w->cells + m * w->items;
        uint8_t served = l->included[index], changed = 0;
        for (int32_t n = w->lead; n < w->lead + w->leads; n++)
            served = served && !isnan(k->goals[n][row]);
        for (int32_t c = 0; c < w->items; c++) {
            int32_t t = goal_tick(&cells[c], k->goals[cells[c].interface][row], l->ceiling[index]);
            changed |= t != ticks[c];
            ticks[c] = t;
        }
        changed |= served && !w->served[m];
        w->served[m] = served;
        /* A changed goal is sent in two cycles, because the first packet may be lost without notice. */
        int due = served && (changed || w->always || w->again[m] || w->sent_at[m] <= cycle - REPEATED);
        w->again[m] = changed;
        if (!due)
            continue;
        w->sent_at[m] = cycle;
        uint8_t *record = packet + size;
        memset(record, 0, (size_t)(1 + w->length));
        record[0] = w->ids[m];
        for (int32_t c = 0; c < w->items; c++)
            for (int32_t b = 0; b < cells[c].size; b++)
                record[1 + cells[c].at + b] = (uint8_t)((uint32_t)ticks[c] >> 8 * b);
        size += 1 + w->length;
    }
    if (size == head)
        return 0;
    if (l->protocol == 1) {
        const uint8_t start[] = {0xff, 0xff, 0xfe, (uint8_t)(size - 3), 0x83,
                                 (uint8_t)w->address, (uint8_t)w->length};
        memcpy(packet, start, sizeof start);
        uint8_t sum = 0;
        for (int32_t i = 2; i < size; i++)
            sum = (uint8_t)(sum + packet[i]);
        packet[size++] = (uint8_t)~sum;
    } else {
        const uint8_t start[] = {0xff, 0xff, 0xfd, 0, 0xfe, 0, 0, 0x83,
                                 (uint8_t)w->address, (uint8_t)(w->address >> 8),
                                 (uint8_t)w->length, (uint8_t)(w->length >> 8)};
        memcpy(packet, start, sizeof start);
        size = stuff(packet, size);
        packet[5] = (uint8_t)(size - 5);
        packet[6] = (uint8_t)((size - 5) >> 8);
        uint16_t crc = crc16(0, packet, size);
        packet[size++] = (uint8_t)crc;
        packet[size++] = (uint8_t)(crc >> 8);
    }
    return size;
}

/* Send the due goals of one line. Return OK or FULL. A line that accepts no more bytes is marked `gone`. */
static int write_goals(Kernel *k, Line *l)
{
    uint8_t packet[LONGEST_SYNC_WRITE];
    for (; !l->words[LOST] && !l->gone && k->write_number < l->write_count; k->write_number++) {
        SyncWrite *w = &l->writes[k->write_number];
        /* Byte stuffing adds at most one byte to three, hence 4 / 3; 16 covers header and checksum. */
        if (!has_room(k, RECORD_HEADER + 16 + (w->length + 1) * w->count * 4 / 3))
            return FULL;
        int32_t size = build(k, l, w, packet);
        int64_t before = now_ns(k);
        if (!size || !send_all(k, l, packet, size))
            continue;
        put_record(k, l, INSTRUCTION, 0xfe, before, now_ns(k), packet, size);
        occupy(l, before, size);
    }
    k->write_number = 0;
    return OK;
}

/* Send the due goals of every line. FULL: commit the log and call again. UNEXPECTED: a line is gone, and the other
 * lines have their goals. */
int32_t dxl_write(Kernel *k)
{
    int32_t gone = 0;
    for (; k->write_line < k->line_count; k->write_line++)
        if (write_goals(k, &k->lines[k->write_line]) == FULL)
            return FULL;
    k->write_line = 0;
    for (int32_t i = 0; i < k->line_count; i++)
        gone += k->lines[i].gone != 0;
    return gone || k->raised ? UNEXPECTED : OK;
}

/* End a cycle that the parser finishes, and drop all pending reads. */
void dxl_abandon(Kernel *k)
{
    k->reserved = 0;
    for (int32_t i = 0; i < k->line_count; i++) {
        k->lines[i].state = IDLE;
        k->lines[i].done = k->lines[i].have = k->lines[i].pieces = 0;
    }
}

/* Return the checksum of this source; kernel.py compares it, because it reads the structs from the source. */
uint32_t dxl_source(void) { return SOURCE_CRC; }
