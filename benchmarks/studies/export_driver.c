/* Takes the samples of a file through an exported monitor, for benchmarks/export.py: driver SAMPLES IMAGE ROWS.
 *
 * A sample is three doubles and a restart, all doubles; a row is that of an evaluation with its verdict behind it, and
 * what was found frozen since the row before. The image is read, unless it is empty, and written back. */
#include "servo_monitor.h"

#include <stdio.h>
#include <string.h>
#include <time.h>

int main(int count, char **names)
{
    static servo_monitor_state state;
    static servo_monitor_evaluation q;
    static unsigned char image[SERVO_MONITOR_IMAGE_BYTES];
    static servo_monitor_signals signals;
    static double row[SERVO_MONITOR_ROW + 1]; /* without the number of updates, with the verdict and what is frozen */
    int frozen = 0;
    static double block[4096][4];
    FILE *samples;
    FILE *rows;
    FILE *saved;
    size_t found;
    size_t k;
    clock_t spent = 0;

    if (count != 4) {
        return 2;
    }
    samples = fopen(names[1], "rb");
    saved = fopen(names[2], "rb");
    rows = fopen(names[3], "wb");
    if ((samples == NULL) || (saved == NULL) || (rows == NULL)) {
        return 2;
    }
    servo_monitor_init(&state);
    servo_monitor_signals_init(&signals);
    if ((fread(image, sizeof image, 1, saved) == 1) && (servo_monitor_load(&state, image) == 0)) {
        return 3;
    }
    while ((found = fread(block, sizeof block[0], 4096, samples)) > 0) {
        const clock_t begin = clock();

        for (k = 0; k < found; k++) {
            if (block[k][3] > 0.0) {
                servo_monitor_restart(&state);
            }
            frozen |= servo_monitor_frozen(&signals, block[k][0], block[k][1], block[k][2]);
            if (servo_monitor_step(&state, block[k][0], block[k][1], block[k][2], &q) != 0) {
                memcpy(row, &q.statistic, (SERVO_MONITOR_ROW - 1) * sizeof row[0]);
                row[SERVO_MONITOR_ROW - 1] = (double)q.verdict;
                row[SERVO_MONITOR_ROW] = (double)frozen;
                frozen = 0;
                fwrite(row, sizeof row, 1, rows);
            }
        }
        spent += clock() - begin;
    }
    servo_monitor_save(&state, image);
    saved = freopen(names[2], "wb", saved);
    if ((saved == NULL) || (fwrite(image, sizeof image, 1, saved) != 1)) {
        return 4;
    }
    fclose(saved);
    fclose(rows);
    printf("%.3f\n", (double)spent / (double)CLOCKS_PER_SEC);
    return 0;
}
