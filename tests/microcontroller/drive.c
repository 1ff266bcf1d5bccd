/* Scans from standard input through an export; its corner and window go to standard output.
 *
 * A scan is its ranges, x, y, theta (float32) and its time (uint32). On ARM it is a program for Linux without any
 * library, so that qemu-arm runs what was compiled for a microcontroller. */
#include "echogrid.h"

struct scan {
    float ranges[ECHOGRID_SONARS], x, y, theta;
    uint32_t ms;
};

static struct echogrid map;
static int8_t cells[ECHOGRID_CELLS];

#ifdef __arm__
static long called(long number, long first, const void* second, unsigned long third) {
    register long r7 __asm__("r7") = number;
    register long r0 __asm__("r0") = first;
    register const void* r1 __asm__("r1") = second;
    register unsigned long r2 __asm__("r2") = third;
    __asm__ volatile("svc #0" : "+r"(r0) : "r"(r7), "r"(r1), "r"(r2) : "memory");
    return r0;
}

static long take(void* to, unsigned long size) { return called(3, 0, to, size); }

static long put(const void* from, unsigned long size) { return called(4, 1, from, size); }
#else
#include <unistd.h>

static long take(void* to, unsigned long size) { return read(0, to, size); }

static long put(const void* from, unsigned long size) { return write(1, from, size); }
#endif

static int taken(void* to, unsigned long size) {
    char* at = to;
    while (size > 0) {
        const long part = take(at, size);
        if (part <= 0) {
            return 0;
        }
        at += part;
        size -= (unsigned long)part;
    }
    return 1;
}

static int driven(void) {
    struct scan scan;
    float corner[2];
    int status = ECHOGRID_DONE;
    echogrid_start(&map);
    while (taken(&scan, sizeof scan)) {
        status |= echogrid_scan(&map, scan.ranges, scan.x, scan.y, scan.theta, scan.ms);
    }
    echogrid_corner(&map, &corner[0], &corner[1]);
    echogrid_read(&map, cells);
    return status | (put(corner, sizeof corner) < 0) | (put(cells, sizeof cells) < 0);
}

#ifdef __arm__
void _start(void);

void _start(void) { called(1, driven(), 0, 0); }
#else
int main(void) { return driven(); }
#endif
