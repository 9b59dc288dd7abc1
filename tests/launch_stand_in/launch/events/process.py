"""Events of processes."""

from launch import ProcessExited as ProcessExited
