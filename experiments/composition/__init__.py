"""Control of the composition of a culture of two species by temperature: estimate, laws, and both in one controller.

The control loop and the comparisons use it; it knows no clock, file or device.
"""
