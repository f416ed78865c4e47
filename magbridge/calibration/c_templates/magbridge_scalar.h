/* Made by magbridge export: compensation of the scalar magnetometer $column.
 * Do not edit.
 *
 * Compile with -DMAGBRIDGE_FLOAT for float; otherwise double. No allocation, no state.
 */
#ifndef MAGBRIDGE_SCALAR_H
#define MAGBRIDGE_SCALAR_H

#ifdef MAGBRIDGE_FLOAT
typedef float magbridge_scalar_real;
#else
typedef double magbridge_scalar_real;
#endif

#define MAGBRIDGE_SCALAR_CHANNELS $count
$names
typedef struct {
    magbridge_scalar_real field, sigma, level_sigma; /* nT */
    int extrapolated; /* a channel is outside the range that was calibrated */
} magbridge_scalar_corrected;

/* reading: nT, as read; vector: the corrected vector, nT; turn: rate of its unit vector, 1/s; rate: rate of
 * the reading, nT/s; channels: in the order and the units above; same_power_cycle: 1 as long as the sensor
 * has not been switched off since the calibration, else 0: its level is then not known. */
void magbridge_correct_scalar(magbridge_scalar_real reading, const magbridge_scalar_real vector[3],
                              const magbridge_scalar_real turn[3], magbridge_scalar_real rate,
                              const magbridge_scalar_real *channels, int same_power_cycle,
                              magbridge_scalar_corrected *out);

#endif
