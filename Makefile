# make setup | build | demo | test | lint | docs | clean
#
#   make demo EFFECT=torque_constant SEED=3     hide this effect in the simulated robot and find it
#   make test PACKAGES="cg_sysid cg_dynamics"   only these packages
#   make setup PYTHON=/usr/bin/python3.12       with this interpreter

SHELL := /bin/bash
.PHONY: setup build demo test lint docs lock clean distclean help
.NOTPARALLEL:

export PYTHON

help:
	@sed -n '1,/^$$/s/^# \{0,1\}//p' Makefile

setup:
	@tools/setup.sh

build:
	@tools/setup.sh base build ros
	@tools/build.sh

demo: build
	@./cg run cg_bringup demo $(if $(EFFECT),--effect '$(EFFECT)') $(if $(SEED),--seed '$(SEED)')

test: setup
	@tools/build.sh
	@tools/test.sh $(PACKAGES)

lint:
	@tools/setup.sh base build ros test
	@tools/lint.sh

docs:
	@tools/setup.sh docs
	@.venv/bin/mkdocs build --quiet --strict
	@echo 'docs: build/site/index.html'

lock:
	@tools/lock.sh

clean:
	rm -rf build install log .mypy_cache .ruff_cache .pytest_cache .hypothesis

distclean: clean
	rm -rf .venv
