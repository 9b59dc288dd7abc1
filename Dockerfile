# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# The two commands, `make run` and `make test`, on a machine with nothing but Docker:
#
#     docker build -t pdeloop .
#     docker run --rm -v "$PWD/runs:/pdeloop/runs" pdeloop
#     docker run --rm pdeloop make test
#
# The image has a compiler, git and make. Nodes communicate over loopback, which is separate in each container.
FROM python:3.11-bookworm
WORKDIR /pdeloop
COPY . .
RUN make setup
ENV PATH="/pdeloop/.venv/bin:$PATH"
CMD ["make", "run"]
