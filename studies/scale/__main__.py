from studies.scale import main

main()
