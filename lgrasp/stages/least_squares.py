"""Numbers of the damped least squares that put links on an object."""

from typing import Annotated

from pydantic import Field

Damping = Annotated[float, Field(gt=0, le=1, description="Damping of the least squares.")]
JointStep = Annotated[float, Field(gt=0, le=3, description="Largest joint change in one step [rad or m].")]
Indentation = Annotated[float, Field(ge=0, le=0.002, description="How far fingers aim to press in at a contact.")]
Gap = Annotated[float, Field(gt=0, le=0.01, description="Largest difference from that.")]
